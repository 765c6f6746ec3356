"""Odd hooks by the thousand: nothing but the package's own errors may come of them.

    python tests/tools/fuzz_hooks.py --count 3000 --seed 0

Each case is a class with one to three odd hooks: they return wrong shapes, types, None, NaN or
objects whose own methods fail, from the first call on or from a later one, or they raise. The class
is played alone and in vector environments, with every way of calling hooks. A case also fails if a
reward is not finite, or if a result has another shape or type than the spaces promise. Exceptions
that hooks raise themselves are the caller's own. See ``fuzz_driver.py``.
"""

import contextlib
import decimal
import fractions
import sys

import gymnasium
import numpy as np
from fuzz_driver import Case, main, require
from odd_values import circular, hostile
from vector_tools import Drawing

from fmugym import FMUGymError, FMUVectorEnv, Normal

WAYS = ("single", "compiled", "array", "per_env", "auto")
NUM_ENVS = 3
STEPS = 4


class HookError(Exception):
    """Raised by hooks themselves: it is theirs, and reaches the caller."""


def ragged():
    return [1.0, [2.0, 3.0]]


# What a hook may return: functions of the hook's environment and of its good result.

CONSTANTS = (
    *(None, True, False, 0, 1, -1, 2**40, 10**400, 0.0, -0.0, 1e-320, 1e308, -1e308),
    *(float("nan"), float("inf"), -float("inf"), 1j, "", "text", "1.5", b"", b"1"),
    *((), (1.0,), (1.0, 2.0), [], [[]], [None], [0.5], [0.5, 0.5], {}, {"x": 1.0}, set(), {1.0}),
    *(np.float32(0.5), np.float64("nan"), np.bool_(True), np.str_("x"), np.datetime64("2020")),
    *(np.array(1.0), np.array([]), np.array(["a"]), np.array([None]), np.zeros(2), np.zeros(3)),
    *(np.zeros(4), np.zeros((2, 3)), np.zeros((3, 2)), np.zeros((3, 3)), np.zeros((1, 3))),
    *(np.full(3, np.nan), np.full(3, np.inf), np.full(3, "x"), np.full(3, 1j), np.full(3, None)),
    *(np.zeros(3, [("a", "f8")]), np.ma.masked_all(3), np.ma.masked, np.zeros(3, np.float16)),
    *(np.zeros(3, np.uint64), np.full(3, 2**63, np.uint64), np.zeros((0, 3)), np.zeros((3, 0))),
    *(decimal.Decimal("0.5"), decimal.Decimal("nan"), fractions.Fraction(1, 3), range(3), slice(1)),
    *(object(), object, len, ..., NotImplemented, memoryview(b"abc"), np.nan * 1j),
)
OBJECTS = (
    lambda: hostile("__bool__"),
    lambda: hostile("__float__"),
    lambda: hostile("__float__", "__repr__"),
    lambda: hostile("__array__"),
    lambda: hostile("__array__", "__repr__"),
    lambda: hostile("__len__"),
    lambda: hostile("__iter__", "__len__", "__getitem__"),
    lambda: hostile("__eq__"),
    lambda: hostile("__getattr__"),
    lambda: hostile("__getattribute__"),
    lambda: hostile("keys", "__getitem__", "items", base=dict),
    lambda: (value for value in (1.0, 2.0, 3.0)),
    lambda: np.random.default_rng(0),
    ragged,
    circular,
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
    *("_get_observation", "_get_info"),
)


def odd_result(rng):
    """A function from the good result to an odd one."""
    kind = rng.choice(("constant", "constant", "object", "distortion", "distortion", "error"))
    if kind == "constant":
        value = rng.choice(CONSTANTS)
        return lambda good: value
    if kind == "object":
        make = rng.choice(OBJECTS)
        return lambda good: make()
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
    """The same with two actions, which can be compiled."""

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

    def hook(self):
        value = good(self)
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
    with contextlib.closing(FMUVectorEnv(cls, NUM_ENVS, hooks=way)) as envs:
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
