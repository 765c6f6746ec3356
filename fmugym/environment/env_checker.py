"""Checks that an environment class keeps the contract of this package.

``check_fmu_env`` finds what often goes wrong when a new FMU is integrated: a reset that does not
restore everything, parameters without effect, observations outside of their space. The project's
own tests run it on every environment and FMI version. ``check_hooks`` finds out whether the hooks
of a class work on the arrays of many environments.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import gymnasium
import numpy as np
from gymnasium.utils.env_checker import data_equivalence

from fmugym.checks import has_method
from fmugym.environment.env import FMUEnv, inner_env
from fmugym.environment.vector.hook_check import CURE, find_difference
from fmugym.environment.vector.task_choice import no_arrays, require_own_order
from fmugym.errors import ConfigError, ContractError, FMUGymError, shown

__all__ = ["check_fmu_env", "check_hooks"]

logger = logging.getLogger(__name__)


_SEED: Final = 0
"""Of the episodes and of the actions."""

_NUM_STEPS: Final = 200
"""Length of each trial."""

_SHORT_EPISODE: Final = 3
"""In steps."""


class _Transition(NamedTuple):
    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    outputs: tuple[float, ...]
    """Those of the FMU. They show more than an observation, which is rounded and may omit some."""


@dataclass(frozen=True)
class _Start:
    """Beginning of an episode."""

    seed: int | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)


def check_fmu_env(env: gymnasium.Env[Any, Any]) -> None:
    """Check that an environment over an FMU keeps its contract.

    The checks run on copies, made from the class and the arguments of its constructor. The
    environment itself is not used.

    Args:
        env: The environment, wrapped or not. Each check makes 200 steps with random actions. When
            an episode ends, another follows.

    Raises:
        ContractError: If the environment breaks the contract; the text says how.
        ConfigError: If it is not an environment of fmugym.
    """
    inner = inner_env(env)
    actions = _sample_actions(inner, _NUM_STEPS)
    for check in _CHECKS:
        check(inner, actions)


def check_hooks(make_env: Callable[..., gymnasium.Env[Any, Any]], **kwargs: Any) -> None:
    """Check that hooks return the same on arrays as for one environment at a time.

    A class whose hooks pass may say ``vectorized = True``: a vector environment then calls each of
    them once a step.

    The check plays episodes of at most 200 steps. It calls each hook on their states, at limits,
    where episodes have just begun and where the FMU has failed: for one environment, for as many as
    the observation has elements, and for another number.

    Args:
        make_env: The class, or another callable that makes an environment.
        kwargs: Its arguments.

    Raises:
        ContractError: If a hook differs on arrays; the text says which one, and in what: a value,
            a shape, or that it changes what it should not.
        ConfigError: If it is not an environment of fmugym.
    """
    if not callable(make_env):
        raise ConfigError(f"expected a class or a function, got {shown(make_env)}")
    env = make_env(**kwargs)
    try:
        inner = inner_env(env)
        require_own_order(inner)
        difference = no_arrays(inner) or find_difference(inner)
    finally:
        if has_method(env, "close"):
            env.close()
    if difference is not None:
        raise ContractError(f"{type(inner).__name__}: {difference}. {CURE}")


def _sample_actions(env: FMUEnv, count: int) -> list[Any]:
    space = copy.deepcopy(env.action_space)
    space.seed(_SEED)
    return [space.sample() for _ in range(count)]


@contextmanager
def _fresh(env: FMUEnv) -> Iterator[FMUEnv]:
    """A new environment of the same class and arguments, without a window."""
    fresh = copy.deepcopy(env)
    fresh.render_mode = None
    try:
        yield fresh
    finally:
        fresh.close()


def _rollout(env: FMUEnv, actions: list[Any]) -> list[_Transition]:
    """Run episodes one after another; only the first is seeded."""
    transitions: list[_Transition] = []
    start, played = _Start(_SEED), 0
    while played < len(actions):
        episode = _episode(env, actions[played:], start)
        transitions += episode
        start, played = _Start(), played + len(episode) - 1
    return transitions


def _episode(env: FMUEnv, actions: list[Any], start: _Start) -> list[_Transition]:
    """Run an episode until it ends or there are no more actions."""
    options = {"model_parameters": dict(start.parameters)}
    observation, _ = env.reset(seed=start.seed, options=options)
    transitions = [_Transition(observation, 0.0, False, False, tuple(env.out.values()))]
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        if "fault" in info:
            raise ContractError(f"a step with a sampled action failed: {info['fault']}")
        outputs = tuple(env.out.values())
        transitions.append(_Transition(observation, reward, terminated, truncated, outputs))
        if terminated or truncated:
            break
    return transitions


def _require_equal(what: str, first: list[_Transition], second: list[_Transition]) -> None:
    for index, (a, b) in enumerate(zip(first, second, strict=False)):
        for name, left, right in zip(a._fields, a, b, strict=True):
            if not data_equivalence(left, right, exact=True):
                raise ContractError(f"{what}: at step {index} {name} was {left}, then {right}")
    if len(first) != len(second):
        raise ContractError(f"{what}: the episodes end at different steps")


def _check_determinism(env: FMUEnv, actions: list[Any]) -> None:
    with _fresh(env) as first, _fresh(env) as second:
        _require_equal(
            "two environments with the same seed and actions differ",
            _rollout(first, actions),
            _rollout(second, actions),
        )


def _check_reset(env: FMUEnv, actions: list[Any]) -> None:
    """Compare episodes of one environment with those of fresh ones, as the trial of an FMU does.

    Episodes follow short and long ones, with the same start values as before and with others.
    """
    starts = _Start(_SEED), _other_start(env, actions)
    references = [_fresh_episode(env, actions, start) for start in starts]
    short, long = min(_SHORT_EPISODE, len(actions)), len(actions)
    with _fresh(env) as tried:
        for index, steps in ((0, short), (0, long), (0, long), (1, short), (0, long), (1, long)):
            again = _episode(tried, actions[:steps], starts[index])
            what = "reset does not restore everything: compared with a new environment"
            _require_equal(what, references[index][: steps + 1], again)


def _fresh_episode(env: FMUEnv, actions: list[Any], start: _Start) -> list[_Transition]:
    with _fresh(env) as fresh:
        return _episode(fresh, actions, start)


def _other_start(env: FMUEnv, actions: list[Any]) -> _Start:
    """Another seed and, if the FMU runs with them, parameters that differ by one percent."""
    with _fresh(env) as tried:
        tried.reset(seed=_SEED)
        changed = {n: _changed(tried, n, value) for n, value in tried.parameters.items()}
        start = _Start(
            _SEED + 1, {name: value for name, value in changed.items() if value is not None}
        )
        try:
            _episode(tried, actions, start)
        except FMUGymError:
            return _Start(_SEED + 1)
        return start


def _check_results(env: FMUEnv, actions: list[Any]) -> None:
    with _fresh(env) as tried:
        for transition in _rollout(tried, actions):
            _require_type("reward", transition.reward, float)
            _require_type("terminated", transition.terminated, bool)
            _require_type("truncated", transition.truncated, bool)
            if not math.isfinite(transition.reward):
                raise ContractError(f"a reward is {transition.reward}")
            if not tried.observation_space.contains(transition.observation):
                raise ContractError(
                    f"observation {transition.observation!r} is not in {tried.observation_space}"
                )


def _require_type(what: str, value: Any, expected: type) -> None:
    if not isinstance(value, expected):
        raise ContractError(
            f"{what} is of type {type(value).__name__}, expected {expected.__name__}"
        )


def _check_time(env: FMUEnv, actions: list[Any]) -> None:
    with _fresh(env) as tried:
        tried.reset(seed=_SEED)
        start, step = tried.time, tried.interface.time_step
        for count, action in enumerate(actions, start=1):
            *_, terminated, truncated, _ = tried.step(action)
            expected = start + count * step
            if not math.isclose(tried.time, expected, rel_tol=1e-15, abs_tol=1e-15):
                raise ContractError(f"time is {tried.time} after {count} steps, not {expected}")
            if terminated or truncated:
                return


def _check_parameters(env: FMUEnv, actions: list[Any]) -> None:
    """A parameter must have the value that was set, and another value must have an effect.

    Strings are left out: FMUs need not be able to tell them.
    """
    with _fresh(env) as tried:
        tried.reset(seed=_SEED)
        given = {n: v for n, v in tried.parameters.items() if not isinstance(v, str)}
        read = tried.read_variables(*given)
        for name, value in given.items():
            if not math.isclose(read[name], value, rel_tol=1e-6):
                raise ContractError(f"parameter {name!r} was set to {value}, but is {read[name]}")
        before = _trace(tried, actions, {})
        for name, value in given.items():
            changed = _changed(tried, name, value)
            if changed is not None and _trace(tried, actions, {name: changed}) == before:
                logger.warning(
                    "parameter %r has no effect on the outputs: %g gives the same as %g",
                    name,
                    changed,
                    value,
                )


def _changed(env: FMUEnv, name: str, value: float) -> float | None:
    """Return a value one percent away, in the range of a Real; None for inputs and other types."""
    if name in env.interface.input_names:
        return None
    variable = env.fmu.variable(name)
    if variable.kind != "real":
        return None
    nominal = abs(value) or abs(variable.nominal or 1.0)
    for candidate in (value + 0.01 * nominal, value - 0.01 * nominal):
        with suppress(ConfigError):
            env.interface.within(variable, candidate)
            return candidate
    return None


def _trace(
    env: FMUEnv, actions: list[Any], parameters: dict[str, float]
) -> list[tuple[float, ...]]:
    """Return the outputs of one episode."""
    env.reset(seed=_SEED, options={"model_parameters": parameters})
    trace = [env.state]
    for action in actions:
        *_, terminated, truncated, _ = env.step(action)
        trace.append(env.state)
        if terminated or truncated:
            break
    return trace


def _check_hooks(env: FMUEnv, actions: list[Any]) -> None:
    """A second call of a hook after a step must return the same and change nothing."""
    with _fresh(env) as tried:
        tried.reset(seed=_SEED)
        for action in actions[:20]:
            observation, reward, terminated, truncated, _ = tried.step(action)
            if terminated or truncated:
                tried.reset()
                continue
            before = _readable(tried)
            repeated = tried._get_observation()
            if not data_equivalence(observation, repeated, exact=True):
                raise ContractError("_get_observation has a side effect: called again it differs")
            if _shares_memory(observation, repeated):
                raise ContractError("_get_observation returns the same array again, not a new one")
            for hook, value in ((tried._is_done, terminated), (tried._reward_policy, reward)):
                if hook() != value:
                    raise ContractError(f"{hook.__name__} has a side effect: it was {value}")
            if not data_equivalence(before, _readable(tried), exact=True):
                raise ContractError("a hook other than _get_inputs and _update changes values")


def _readable(env: FMUEnv) -> dict[str, Any]:
    """Return the values that hooks may read."""
    return {
        "out": dict(env.out),
        "inputs": env.inputs,
        "previous_state": env.previous_state,
        "step_count": env.step_count,
        "parameters": dict(env.parameters),
        "variables": dict(env.variables),
    }


def _shares_memory(first: Any, second: Any) -> bool:
    if isinstance(first, dict):
        return any(_shares_memory(first[key], second[key]) for key in first)
    both = isinstance(first, np.ndarray) and isinstance(second, np.ndarray)
    return both and np.shares_memory(first, second)


def _check_close(env: FMUEnv, actions: list[Any]) -> None:
    with _fresh(env) as tried:
        tried.reset(seed=_SEED)
        tried.close()
        tried.close()


_CHECKS = (
    _check_results,
    _check_time,
    _check_determinism,
    _check_reset,
    _check_parameters,
    _check_hooks,
    _check_close,
)
