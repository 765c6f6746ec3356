"""Hooks that change what outlives a call: defaults, closures, classes, functions.

They are called as often as a task asks for, and in Python: what a trial of them would change could
change results.
"""

import collections
import functools
import itertools
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import fmugym
from fmugym import ConfigError

STEPS = 6


class Swing(fmugym.FMI2CSEnv):
    """A pendulum whose reward is a count, less the angle."""

    def __init__(self, **options):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": 0.3},
            "time_step": 0.02,
            "bounds": {"tau": (-0.01, 0.01)},
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config, **options)

    def _is_done(self):
        return self.out["q"] > 3.0


def counting(count):
    """A class whose reward is what a function counts, which has no argument, less the angle."""

    class Counting(Swing):
        def _reward_policy(self):
            return count() - self.out["q"]

    return Counting


def with_default(value, count):
    """A class with a default argument, by which a function counts."""

    class Counting(Swing):
        def _reward_policy(self, kept=value):
            return count(kept) - self.out["q"]

    return Counting


def first_plus_one(kept):
    kept[0] = kept[0] + 1.0
    return kept[0]


def added(kept):
    kept.append(1.0)
    return len(kept)


def attribute_plus_one(kept):
    kept.n = kept.n + 1.0
    return kept.n


def default_of_keyword():
    class Counting(Swing):
        def _reward_policy(self, *, kept=SimpleNamespace(n=0.0)):  # noqa: B008
            return attribute_plus_one(kept) - self.out["q"]

    return Counting


def default_of_helper():
    def helper(kept=[0.0]):  # noqa: B006
        return first_plus_one(kept)

    return counting(helper)


def default_of_static_method():
    class Counting(Swing):
        @staticmethod
        def count(kept=[0.0]):  # noqa: B006
            return first_plus_one(kept)

        def _reward_policy(self):
            return self.count() - self.out["q"]

    return Counting


def default_of_property():
    class Counting(Swing):
        @property
        def count(self, kept=[0.0]):  # noqa: B006
            return first_plus_one(kept)

        def _reward_policy(self):
            return self.count - self.out["q"]

    return Counting


def default_that_is_a_function():
    def helper(kept=[0.0]):  # noqa: B006
        return first_plus_one(kept)

    return with_default(helper, lambda kept: kept())


def default_of_an_inner_function():
    outer = [0.0]

    def helper():
        def inner(kept=outer):
            return first_plus_one(kept)

        return inner()

    return counting(helper)


def default_of_the_observation():
    class Counting(Swing):
        def _get_observation(self, kept=[0.0]):  # noqa: B006
            return np.array([first_plus_one(kept), self.out["q"]], np.float32)

    return Counting


def default_of_the_update():
    kept = SimpleNamespace(n=0.0)

    class Counting(Swing):
        def _update(self, kept=kept):
            attribute_plus_one(kept)

        def _reward_policy(self):
            return kept.n - self.out["q"]

    return Counting


def default_of_the_end():
    class Counting(Swing):
        def _is_done(self, kept=[0.0]):  # noqa: B006
            return first_plus_one(kept) + 0.0 * self.out["q"] > STEPS - 1

    return Counting


def default_of_the_inputs():
    class Counting(Swing):
        def _get_inputs(self, kept=[0.0]):  # noqa: B006
            kept[0] = 0.5 * kept[0] + 0.5 * self.action[0]
            return kept[0]

    return Counting


def variable_of_a_closure():
    n = 0.0

    def count():
        nonlocal n
        n = n + 1.0
        return n

    return counting(count)


def method_of_a_list():
    kept = []
    add = kept.append

    def count():
        add(1.0)
        return len(kept)

    return counting(count)


def closure(value, count):
    return counting(lambda: count(value))


def attribute_of_a_function():
    def count():
        return attribute_plus_one(count)

    count.n = 0.0
    return counting(count)


def attribute_of_a_class():
    class Kept:
        n = 0.0

    return counting(lambda: attribute_plus_one(Kept))


def attribute_of_its_class():
    class Counting(Swing):
        n = 0.0

        def _reward_policy(self):
            return attribute_plus_one(type(self)) - self.out["q"]

    return Counting


def attribute_of_its_base_class():
    class Base(Swing):
        n = 0.0

    class Counting(Base):
        def _reward_policy(self):
            return attribute_plus_one(Base) - self.out["q"]

    return Counting


def list_of_its_class():
    class Counting(Swing):
        past = [0.0]  # noqa: RUF012

        def _reward_policy(self):
            return first_plus_one(self.past) - self.out["q"]

    return Counting


def class_method():
    class Counting(Swing):
        n = 0.0

        @classmethod
        def count(cls):
            return attribute_plus_one(cls)

        def _reward_policy(self):
            return self.count() - self.out["q"]

    return Counting


def attribute_of_a_module():
    kept = sys.modules["kept_by_hooks"] = ModuleType("kept_by_hooks")
    kept.n = 0.0

    def count():
        import kept_by_hooks

        kept_by_hooks.n = kept_by_hooks.n + 1.0
        return kept_by_hooks.n

    return counting(count)


class Callable:
    """An object that counts its calls."""

    def __init__(self):
        self.n = 0.0

    def __call__(self):
        return attribute_plus_one(self)


DEFAULTS = {
    "a namespace": lambda: with_default(SimpleNamespace(n=0.0), attribute_plus_one),
    "a list": lambda: with_default([0.0], first_plus_one),
    "a list that grows": lambda: with_default([], added),
    "a dict": lambda: with_default({0: 0.0}, first_plus_one),
    "an array": lambda: with_default(np.zeros(1), first_plus_one),
    "a deque": lambda: with_default(collections.deque([0.0]), first_plus_one),
    "a tuple of lists": lambda: with_default(([0.0],), lambda kept: first_plus_one(kept[0])),
    "an iterator": lambda: with_default(itertools.count(), next),
    "a generator": lambda: with_default((float(n) for n in range(99)), next),
    "random numbers": lambda: with_default(np.random.default_rng(0), lambda rng: rng.uniform()),
    "a method": lambda: with_default([0.0].append, lambda add: (add(1.0), len(add.__self__))[1]),
    "a partial": lambda: with_default(functools.partial(first_plus_one, [0.0]), lambda f: f()),
    "an object": lambda: with_default(Callable(), lambda kept: kept()),
    "of a keyword": default_of_keyword,
    "of a helper": default_of_helper,
    "of a static method": default_of_static_method,
    "of a property": default_of_property,
    "a function": default_that_is_a_function,
    "of the observation": default_of_the_observation,
    "of the update": default_of_the_update,
    "of the end": default_of_the_end,
    "of the inputs": default_of_the_inputs,
}
OTHERS = {
    "default of an inner function": default_of_an_inner_function,
    "variable of a closure": variable_of_a_closure,
    "namespace in a closure": lambda: closure(SimpleNamespace(n=0.0), attribute_plus_one),
    "list in a closure": lambda: closure([0.0], first_plus_one),
    "list that grows": lambda: closure([], added),
    "array in a closure": lambda: closure(np.zeros(1), first_plus_one),
    "object in a closure": lambda: counting(Callable()),
    "method of a list": method_of_a_list,
    "attribute of a function": attribute_of_a_function,
    "attribute of a class": attribute_of_a_class,
    "attribute of its class": attribute_of_its_class,
    "attribute of its base class": attribute_of_its_base_class,
    "list of its class": list_of_its_class,
    "class method": class_method,
    "attribute of a module": attribute_of_a_module,
}
ACTION = np.array([0.005], np.float32)


def steps(env, action):
    """Observation, reward and end of each step."""
    env.reset(seed=0)
    rows = []
    for _ in range(STEPS):
        observation, reward, terminated, *_ = env.step(action)
        rows.append([*np.ravel(observation), *np.ravel(reward), *np.ravel(terminated)])
    return np.array(rows)


@pytest.fixture(params=DEFAULTS | OTHERS, ids=DEFAULTS | OTHERS)
def make(request):
    return (DEFAULTS | OTHERS)[request.param]


@pytest.fixture
def expected(make, opened):
    return steps(opened(make()(hooks="python")), ACTION)


def test_a_single_environment_calls_them_once_a_step(make, expected, opened):
    np.testing.assert_array_equal(steps(opened(make()()), ACTION), expected)


def test_a_vector_environment_calls_them_once_a_step(make, expected, make_envs):
    np.testing.assert_allclose(steps(make_envs(make(), 1), ACTION[None]), expected, rtol=1e-6)


@pytest.mark.parametrize("name", DEFAULTS)
def test_defaults_that_may_change_are_named(name, make_envs):
    with pytest.raises(ConfigError, match="default argument kept"):
        make_envs(DEFAULTS[name](), 2, hooks="compiled")


@pytest.mark.parametrize(
    "value",
    [2.0, "text", None, (1.0, (2.0, "b")), np.float32(2.0), np.sin, len, int, np.linalg.norm],
)
def test_other_defaults_are_compiled(value, opened, make_envs):
    class Constant(Swing):
        def _reward_policy(self, kept=value, *, more=value):
            return self.out["q"] - 1.0

    make_envs(Constant, 2, hooks="compiled")
    steps(opened(Constant(hooks="compiled")), ACTION)
