"""Odd hooks by the thousand: nothing but the package's own errors may come of them.

    python tests/fuzz_hooks.py --count 3000 --seed 0

Each case is a class with one to three odd hooks: they return wrong shapes, types, None, NaN or
objects whose own methods fail, from the first call on or from a later one, or they raise. The class
is played alone and in vector environments, with every way of calling hooks. A case fails with an
exception that is neither of ``FMUGymError`` nor raised within a hook, if a reward is not finite, or
if a result has another shape or type than the spaces promise. A crash, or a hang after ``HANG``
seconds, ends the program with the Python stack.

Case number n of a seed is always the same; ``--first`` and ``--count 1`` repeat it.
"""

import argparse
import contextlib
import decimal
import faulthandler
import fractions
import logging
import random
import sys
import time
import warnings
from collections import Counter

import gymnasium
import numpy as np

import fmugym
from fmugym import FMUGymError, FMUVectorEnv, Normal, Uniform

HANG = 60.0
WAYS = ("single", "compiled", "array", "per_env", "auto")
NUM_ENVS = 3
STEPS = 4


class HookError(Exception):
    """Raised by hooks themselves: it is theirs, and reaches the caller."""


def _fail(*arguments, **keywords):
    raise ArithmeticError("this object fails")


def hostile(*names, base=object):
    """Make an object whose special methods of these names raise."""
    return type("Hostile", (base,), dict.fromkeys(names, _fail))()


def ragged():
    return [1.0, [2.0, 3.0]]


def circular():
    values = [1.0]
    values.append(values)
    return values


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


class Swing(fmugym.FMUEnv):
    """A pendulum whose hooks are element-wise arithmetic."""

    def __init__(self, **changes):
        config = {
            "model_input_names": ["tau"],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": Uniform(-1.0, 1.0)},
            "bounds": {"tau": (-0.01, 0.01)},
            "time_step": 0.02,
            "max_episode_steps": 3,
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config | changes)

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


def make_case(seed, number):
    """The way of calling hooks, what the case is, and the class."""
    rng = random.Random(f"{seed}/{number}")
    cls, title = odd_class(rng)
    return rng.choice(WAYS), title, cls


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


class ResultError(Exception):
    """A result that was passed on is not what a caller may expect."""


def require(holds, what):
    if not holds:
        raise ResultError(what)


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
    """Whether an exception was raised within a hook, or by an object that a hook made."""
    trace = error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if code.co_filename == __file__ and code.co_name in {"hook", "fail", "_fail", *HOOKS}:
            return code.co_name != "_fail"
        trace = trace.tb_next
    return False


def watch(way, cls):
    """Play a case; returns what became of it and what is wrong with that."""
    faulthandler.dump_traceback_later(HANG, exit=True)
    try:
        play(way, cls)
    except FMUGymError:
        return "refused", ""
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        if is_of_a_hook(error):
            return "raised by the hook", ""
        return "failed", f"{type(error).__name__}: {place_of(error)}"
    finally:
        faulthandler.cancel_dump_traceback_later()
    return "accepted", ""


def place_of(error):
    """What an error says, and the last place in the package that it passed."""
    place, trace = "", error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if "fmugym" in code.co_filename.replace("\\", "/").split("/"):
            place = f"{code.co_filename.rpartition('fmugym/')[2]}:{trace.tb_lineno}"
        trace = trace.tb_next
    try:
        text = str(error)
    except Exception:
        text = "?"
    return f"{text[:100]} ({place})"


def run(count, seed, first=0, report=lambda line: None):
    """Run cases one after another.

    Returns:
        How many had which outcome, by way of calling hooks, and the failures as texts.
    """
    counts, failures = Counter(), []
    with quiet():
        for number in range(first, first + count):
            way, title, cls = make_case(seed, number)
            outcome, trouble = watch(way, cls)
            counts[way, outcome] += 1
            if trouble:
                failures.append(f"case {number}: {way}: {title}: {trouble}")
                report(failures[-1])
    return counts, failures


@contextlib.contextmanager
def quiet():
    """Without warnings, which odd hooks bring about by the thousand, and log messages."""
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)


def table(counts):
    outcomes = ("accepted", "refused", "raised by the hook", "failed")
    return [
        f"{way}: " + ", ".join(f"{counts[way, outcome]} {outcome}" for outcome in outcomes)
        for way in WAYS
    ]


def say(text):
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--seed", default="0")
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    faulthandler.enable()
    begin = time.perf_counter()
    counts, failures = run(arguments.count, arguments.seed, arguments.first, say)
    for line in table(counts):
        say(line)
    say(f"{len(failures)} of {arguments.count} failed, {time.perf_counter() - begin:.0f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
