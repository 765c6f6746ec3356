"""Odd hooks by the thousand: nothing but the package's own errors may come of them.

    python tests/tools/fuzz_hooks.py --count 3000 --seed 0

Each case is a class with one to three odd hooks: they return wrong shapes, types, None, NaN or
objects whose own methods fail, from the first call on or from a later one, or they raise. The class
is played alone and in vector environments, with every way of calling hooks. A case also fails if a
reward is not finite, or if a result has another shape or type than the spaces promise. Exceptions
that hooks raise themselves are the caller's own. See ``fuzz_driver.py``.
"""

import contextlib
import sys

import gymnasium
import numpy as np
from fuzz_driver import Case, main, require
from fuzz_odd_values import odd
from vector_tools import Drawing
from ways import in_way

from fmugym import FMUGymError, FMUVectorEnv, Normal

WAYS = ("single", "arrays", "one by one")
NUM_ENVS = 3
STEPS = 4


class HookError(Exception):
    """Raised by hooks themselves: it is theirs, and reaches the caller."""


# What a hook may return: functions of the hook's environment and of its good result.

ROWS = (
    *((1.0,), (1.0, 2.0), [0.5], [0.5, 0.5], {"x": 1.0}, [1.0, [2.0, 3.0]], np.ma.masked_all(3)),
    *map(np.zeros, (3, 4, (2, 3), (3, 2), (3, 3), (1, 3), (0, 3), (3, 0))),
    *(np.full(3, value) for value in (np.nan, np.inf, "x", 1j, None)),
    *(np.zeros(3, dtype) for dtype in (np.float16, np.uint64, [("a", "f8")])),
)
DISTORTIONS = (
    lambda good: np.asarray(good).T,
    lambda good: np.asarray(good)[..., None],
    lambda good: np.asarray(good)[None],
    lambda good: np.ravel(good)[:-1],
    lambda good: np.append(np.ravel(good), 1.0),
    lambda good: np.asarray(good, object),
    lambda good: np.asarray(good).astype(str),
    lambda good: np.asarray(good, np.complex128),
    lambda good: np.asarray(good, np.float64) * np.nan,
    lambda good: np.asarray(good, np.float64) * 1e300 * 1e300,
    lambda good: np.asarray(good).tolist(),
    lambda good: [good, good],
    lambda good: (good,),
    lambda good: {"value": good},
    lambda good: {1: good, "x": None},
    lambda good: {"a": {"b": {"c": good}}, "_a": good},
    lambda good: str(good),
    lambda good: np.any(good),
    lambda good: np.sum(good),
)
ERRORS = (HookError, ValueError, TypeError, KeyError, ZeroDivisionError, AttributeError, IndexError)
ERRORS += (AssertionError, StopIteration, MemoryError, RecursionError, FMUGymError, OSError)
HOOKS = (
    *("_get_inputs", "_update", "_is_done", "_is_truncated", "_reward_policy"),
    *("_get_observation", "_get_info", "_goal_reward", "_get_episode_parameters"),
    *("_get_action_space", "_get_observation_space"),
)


def odd_result(rng):
    """A function from the good result to an odd one."""
    kind = rng.choice(("row", "row", "odd", "distortion", "distortion", "error"))
    if kind in {"row", "odd"}:
        value = rng.choice(ROWS) if kind == "row" else odd(rng)
        return lambda good: value
    if kind == "distortion":
        return rng.choice(DISTORTIONS)
    error = rng.choice(ERRORS)

    def fail(good):
        raise error("raised by a hook")

    return fail


class Swing(Drawing):
    """A pendulum whose hooks are element-wise arithmetic."""

    def _is_done(self):
        return self.state[0] > 100.0

    def _reward_policy(self):
        return 1.0 - abs(self.state[0])


class Pushed(Swing):
    """The same with two actions."""

    def _get_action_space(self):
        return gymnasium.spaces.Discrete(2)

    def _get_inputs(self):
        return 0.01 * self.action


class Integrating(Swing):
    """The same with an episode variable."""

    def __init__(self):
        super().__init__(episode_variables={"sum": 0.0, "target": Normal(0.0, 1.0)})

    def _update(self):
        self.variables["sum"] = self.variables["sum"] + self.state[0]

    def _get_info(self):
        return {"sum": self.variables["sum"], "q": self.state[0]}


class Nested(Swing):
    """The same with observations of two parts."""

    def _get_observation_space(self):
        box = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        return gymnasium.spaces.Dict({"state": box, "speed": gymnasium.spaces.Box(-9.0, 9.0, ())})

    def _get_observation(self):
        q, q_dot = self.state
        speed = np.asarray(q_dot, np.float32)
        return {"state": np.array([q, q_dot], np.float32), "speed": speed}


BASES = (Swing, Pushed, Pushed, Integrating, Nested)


def odd_hook(name, base, distort, first, in_variable):
    """A hook that is odd from its call number ``first`` on."""
    good = getattr(base, name)
    calls = iter(range(10**9))

    def hook(self, *arguments):
        value = good(self, *arguments)
        if next(calls) < first:
            return value
        if in_variable:
            self.variables["sum"] = distort(self.variables["sum"])
            return value
        return distort(value)

    hook.__name__ = name
    return hook


def odd_class(rng):
    """A class with odd hooks, and what to call it."""
    base = rng.choice(BASES)
    names = rng.sample(HOOKS, rng.choice((1, 1, 1, 2, 3)))
    first = rng.choice((0, 0, 0, 1, 30, 90, 200))
    in_variable = base is Integrating and rng.random() < 0.3
    hooks = {n: odd_hook(n, base, odd_result(rng), first, in_variable) for n in names}
    return type("Odd", (base,), hooks), f"{base.__name__} {'+'.join(names)} from call {first}"


def play(way, cls):
    if way == "single":
        with contextlib.closing(cls()) as env:
            play_single(env)
        return
    with contextlib.closing(FMUVectorEnv(in_way(way, cls), NUM_ENVS)) as envs:
        play_many(envs)


def play_single(env):
    env.action_space.seed(0)
    for seed in (1, None):
        observation, _ = env.reset(seed=seed)
        require_element(env.observation_space, observation, exact=False)
        for _ in range(STEPS):
            observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            require_element(env.observation_space, observation, exact=False)
            require(type(reward) is float and np.isfinite(reward), f"reward {reward!r}")
            require(type(terminated) is type(truncated) is bool, "flags")
            if terminated or truncated:
                break


def play_many(envs):
    envs.action_space.seed(0)
    for seed in (1, None):
        observations, _ = envs.reset(seed=seed)
        require_element(envs.observation_space, observations)
        for _ in range(2 * STEPS):
            observations, *judged, infos = envs.step(envs.action_space.sample())
            require_element(envs.observation_space, observations)
            require(np.isfinite(judged[0]).all(), f"rewards {judged[0]}")
            types = [(array.dtype, array.shape) for array in judged]
            shape = (NUM_ENVS,)
            require(types == [(np.float64, shape), (bool, shape), (bool, shape)], f"{types}")
            require(isinstance(infos, dict), "infos")


def require_element(space, value, exact=True):
    """Shapes are those of the space, and types in vector environments; limits are the user's."""
    if isinstance(space, gymnasium.spaces.Dict):
        require(isinstance(value, dict) and value.keys() == space.spaces.keys(), "keys")
        for name, part in space.spaces.items():
            require_element(part, value[name], exact)
        return
    array = np.asarray(value)
    require(not exact or isinstance(value, np.ndarray), f"observation {type(value).__name__}")
    require(array.dtype == space.dtype or not exact, f"observation of {array.dtype}")
    require(array.shape == space.shape, f"observation of shape {array.shape}")
    require(np.isfinite(array).all(), "observation is not finite")


def is_of_a_hook(error):
    """Whether an exception has passed a hook."""
    trace = error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if code.co_filename == __file__ and code.co_name in {"hook", "fail", *HOOKS}:
            return True
        trace = trace.tb_next
    return False


@contextlib.contextmanager
def program():
    """See ``fuzz_driver.run``."""

    def make(rng, folder):
        cls, title = odd_class(rng)
        way = rng.choice(WAYS)
        return Case(lambda: play(way, cls), way, title, is_own=is_of_a_hook)

    yield make


if __name__ == "__main__":
    sys.exit(main(program, __doc__, 3000))
