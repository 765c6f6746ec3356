"""Workloads of the speed gate, each of which any tree must be able to run.

The same file serves both trees, so it uses only their public face; what has moved between them has
its way in one function here. Every workload does the same work in each turn.
"""

from __future__ import annotations

import inspect
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from user_tasks import Tracking

import fmugym
from fmugym.envs import CartPoleEnv, HouseEnv

__all__ = ["ROWS", "OneHook", "Workload"]

SIZES = (1, 8, 64, 1024)
STEPS = 16
"""Steps of a call of a block."""


class Workload(NamedTuple):
    """Work that is measured.

    Attributes:
        start: Brings it to the state in which each turn begins; it is not measured.
        block: What a turn repeats.
    """

    start: Callable[[], object]
    block: Callable[[], object]


Maker = Callable[[ExitStack], Workload]


# Tasks


class CartPoleOnArrays(fmugym.FMI2CSEnv):
    """The cart-pole of Gymnasium with hooks on arrays."""

    vectorized = True

    def __init__(self) -> None:
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "phi", "phi_dot"],
            "model_parameters": {
                **dict.fromkeys(("x_0", "x_dot_0", "phi_0", "phi_dot_0"), _SMALL),
                "m_pole": 0.1,
                "theta_0": math.pi / 2,
                "solver": "explicit_euler",
                "max_step": 1.0,
            },
            "time_step": 0.02,
            "max_episode_steps": 500,
        }
        super().__init__(fmugym.bundled_fmu("CartPole"), config)

    def _get_action_space(self) -> spaces.Space[Any]:
        return spaces.Discrete(2)

    def _get_observation_space(self) -> spaces.Space[Any]:
        return spaces.Box(-np.inf, np.inf, (4,), np.float32)

    def _get_inputs(self) -> Any:
        return 10.0 * (2.0 * self.action - 1.0)

    def _is_done(self) -> Any:
        x, _, phi, _ = self.state
        return (abs(x) > 2.4) | (abs(phi) > 0.2094)

    def _reward_policy(self) -> Any:
        return 1.0 - (self.done & self.after_end)


_SMALL = fmugym.Uniform(-0.05, 0.05)


class TrackingOnArrays(Tracking):
    """A user's tracking task with hooks on arrays."""

    vectorized = True


class HouseOnArrays(fmugym.FMI2CSEnv):
    """A house whose weather and prices hooks read from arrays."""

    vectorized = True

    def __init__(self) -> None:
        path = Path(inspect.getfile(HouseEnv)).with_name("house_year.csv")
        self.year = np.loadtxt(path, delimiter=",", skiprows=1).T.copy()
        config = {
            "model_input_names": ["u", "T_out", "I_sol", "Q_int"],
            "model_output_names": ["T_op", "T_w", "P"],
            "model_parameters": {"T_m_0": fmugym.Uniform(292.0, 295.0)},
            "time_step": 900.0,
            "max_episode_steps": 672,
        }
        super().__init__(fmugym.bundled_fmu("House"), config)

    def _column(self, index: int) -> Any:
        return np.interp(self.time, self.year[0], self.year[index])

    def _get_action_space(self) -> spaces.Space[Any]:
        return spaces.Box(0.0, 1.0, (1,), np.float32)

    def _get_observation_space(self) -> spaces.Space[Any]:
        return spaces.Box(-np.inf, np.inf, (5,), np.float32)

    def _get_inputs(self) -> Any:
        celsius, sun, people = map(self._column, (1, 2, 3))
        return np.stack([self.action[0] + 0.0 * celsius, celsius + 273.15, sun, people])

    def _is_done(self) -> Any:
        return np.abs(self.out["T_op"] - 293.0) > 50.0

    def _reward_policy(self) -> Any:
        cold = np.maximum(294.0 - self.out["T_op"], 0.0)
        return -(self._column(4) * self.out["P"] / 4000.0 + 0.125 * cold)

    def _get_observation(self) -> Any:
        return np.stack([*self.state, self._column(1), self._column(4)]).astype(np.float32)


def _uniform(low: float, high: float) -> dict[str, Any]:
    return {"distribution": "uniform", "low": low, "high": high}


TRACKING: dict[str, Any] = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.02,
    "episode_length": 5.0,
    "variables": {"tau": {"min": -0.03, "max": 0.03}},
    "parameters": {"q_0": _uniform(-0.5, 0.5), "max_step": 0.02},
    "memory": {
        "target": {"start": _uniform(-1.0, 1.0)},
        "integral": {"start": 0, "update": "clip(integral + dt * (target - q), -1, 1)"},
    },
    "expressions": {"sine": "sin(q)", "cosine": "cos(q)", "error": "target - q"},
    "agent": {
        "actions": ["tau"],
        "observations": ["sine", "cosine", "q_dot", "error", "integral"],
    },
    "terminated": "abs(q_dot) > 30",
    "reward": "-((target - q)**2 + 0.01 * q_dot**2 + 10 * tau**2)",
}
"""The tracking task of ``user_tasks`` as a task file has it."""


class OneHook(fmugym.TaskEnv):
    """A task with a reward of which numpy must find the middle value."""

    vectorized = True

    def _reward_policy(self) -> Any:
        q, q_dot = self.out["q"], self.out["q_dot"]
        rows = np.stack([self.variables["target"] - q, q_dot, q])
        return -np.partition(np.abs(rows), 1, axis=0)[1]


def _tracking(**changes: Any) -> Any:
    return fmugym.load(TRACKING | changes)


_one_hook = partial(_tracking, **{"class": f"{__name__}:OneHook"})
_warming = partial(_tracking, warm_up=1.0, episode_length=0.5)

EXPRESSIONS = {"cart-pole": CartPoleEnv, "house": HouseEnv, "tracking": _tracking}
ARRAYS = {"cart-pole": CartPoleOnArrays, "house": HouseOnArrays, "tracking": TrackingOnArrays}


# Environments


def _vector(stack: ExitStack, make: Callable[[], Any], size: int, **options: Any) -> Any:
    envs = fmugym.FMUVectorEnv(make, size, **{"threads": 1} | options)
    stack.callback(envs.close)
    return envs


def _on_arrays(make: Callable[[], Any]) -> dict[str, Any]:
    """The option for hooks on arrays, for trees that do not go by ``vectorized``."""
    has_option = "hooks" in inspect.signature(fmugym.FMUVectorEnv.__init__).parameters
    return {"hooks": "array"} if has_option and getattr(make, "vectorized", False) else {}


def _steps(make: Callable[[], Any], size: int, stack: ExitStack, **options: Any) -> Workload:
    envs = _vector(stack, make, size, **_on_arrays(make) | options)
    step, actions = envs.step, _actions(envs)

    def block() -> None:
        for action in actions:
            step(action)

    return Workload(partial(envs.reset, seed=0), block)


def _actions(env: Any, count: int = STEPS) -> Sequence[Any]:
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(count)]


def _single(make: Callable[[], Any], stack: ExitStack) -> Workload:
    env = make()
    stack.callback(env.close)
    step, reset, actions = env.step, env.reset, _actions(env)

    def block() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = step(action)
            if terminated or truncated:
                reset()

    return Workload(partial(env.reset, seed=0), block)


def _registered() -> Any:
    return gym.make("fmugym/CartPole-v0")


def _masked_resets(size: int, stack: ExitStack) -> Workload:
    envs = _vector(stack, CartPoleEnv, size, autoreset_mode="disabled")
    options = {"reset_mask": np.arange(size) % 2 == 0}
    return Workload(partial(envs.reset, seed=0), partial(envs.reset, options=options))


def _construction(make: Callable[[], Any], stack: ExitStack) -> Workload:
    def block() -> None:
        with ExitStack() as closing:
            env = make()
            closing.callback(env.close)
            env.reset(seed=0)

    return Workload(lambda: None, block)


def _many(make: Callable[[], Any]) -> Any:
    return fmugym.FMUVectorEnv(make, 64, threads=1)


def _rollouts(size: int, stack: ExitStack) -> Workload:
    envs = _vector(stack, _tracking, size)
    actions = np.random.default_rng(0).uniform(-0.03, 0.03, (size, STEPS, 1)).astype(np.float32)
    with _tracking() as env:
        env.reset(seed=0)
        snapshot = env.save_state()
    return Workload(lambda: None, lambda: envs.rollout(snapshot, actions))


def _pool(size: int, stack: ExitStack) -> Workload:
    """A pool of cart-poles; its makers are no public face, so this function changes with them."""
    from fmugym.pool import PoolSpec
    from fmugym.pool.opening import PoolOptions, open_pool

    fmu = fmugym.FMU(fmugym.bundled_fmu("CartPole"))
    outputs = tuple(map(fmu.variable, ("x", "x_dot", "phi", "phi_dot")))
    spec = PoolSpec((fmu.variable("f"),), outputs, 0.02, num_observed=4)
    pool = open_pool(fmu, spec, size, logging.getLogger(__name__), PoolOptions(threads=1))
    stack.callback(pool.close)

    def block() -> None:
        for _ in range(STEPS):
            pool.step()

    start = partial(pool.reset, (fmu.variable("max_step"),), np.ones((1, size)))
    return Workload(start, block)


def _rows() -> Iterator[tuple[str, Maker]]:
    for size in SIZES:
        for task in EXPRESSIONS:
            yield f"{task}/expressions/{size}", partial(_steps, EXPRESSIONS[task], size)
            yield f"{task}/arrays/{size}", partial(_steps, ARRAYS[task], size)
        for way, makers in (("expressions", EXPRESSIONS), ("arrays", ARRAYS)):
            same = partial(_steps, makers["cart-pole"], size, autoreset_mode="same_step")
            yield f"same-step/{way}/{size}", same
        yield f"warm-up/{size}", partial(_steps, _warming, size)
        yield f"one-hook/{size}", partial(_steps, _one_hook, size, **_on_arrays(OneHook))
        yield f"masked-resets/{size}", partial(_masked_resets, size)
        yield f"rollouts/{size}", partial(_rollouts, size)
        yield f"pool/{size}", partial(_pool, size)
        workers = {"isolation": "process", "workers": 1}
        yield f"workers/{size}", partial(_steps, CartPoleEnv, size, **workers)
    for task, make in EXPRESSIONS.items():
        yield f"single/{task}", partial(_single, make)
        yield f"construction/{task}", partial(_construction, make)
    yield "single/cart-pole/gym.make", partial(_single, _registered)
    yield "single/tracking/hooks", partial(_single, Tracking)
    yield "single/one-hook", partial(_single, _one_hook)
    yield "construction/cart-pole/64", partial(_construction, partial(_many, CartPoleEnv))


ROWS: dict[str, Maker] = dict(_rows())
"""Workloads by name, with the number of environments at its end."""
