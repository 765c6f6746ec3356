"""Functions and objects that environments hold in attributes, called and changed by their hooks."""

import functools

import numpy as np
import pytest
from vector_tools import Drawing, require_pair_equal

from fmugym import ConfigError
from fmugym.vector import FMUVectorEnv
from fmugym.vector.contents import Contents


class WithCost(Drawing):
    """A function in an attribute, made in the constructor."""

    def __init__(self):
        super().__init__()
        self.cost = lambda: self.state[0] * self.state[0]

    def _reward_policy(self):
        return -self.cost()


class Judge:
    """An object that refers to its environment."""

    def __init__(self, env):
        self.env = env

    def __call__(self):
        return -abs(self.env.state[0]) - abs(self.env.out["q_dot"])


class Judged(Drawing):
    def __init__(self):
        super().__init__()
        self.judge = Judge(self)
        self.partial = functools.partial(abs, 1.0)

    def _reward_policy(self):
        return self.judge() + self.partial()


class RewardInAttribute(Drawing):
    """A hook itself in an attribute."""

    def __init__(self):
        super().__init__()
        self._reward_policy = lambda: 2.0 * self.state[1]
        self._is_truncated = lambda: self.state[1] > 0.3
        self._get_info = lambda: {"speed": self.state[1]}


@pytest.mark.parametrize("cls", [WithCost, Judged, RewardInAttribute])
@pytest.mark.parametrize("hooks", ["compiled", "array", "per_env"])
def test_functions_and_objects_that_refer_to_the_environment(cls, hooks):
    require_pair_equal(cls, steps=30, hooks=hooks)


class LowPass:
    """A filter with a state."""

    __slots__ = ("value",)

    def __init__(self):
        self.value = 0.0

    def __call__(self, new):
        self.value += 0.1 * (new - self.value)
        return self.value


class Filtering(Drawing):
    def __init__(self):
        super().__init__()
        self.low_pass = LowPass()

    def _reward_policy(self):
        return self.low_pass(self.state[0])


class CountingInClosure(Drawing):
    """The state of a filter in a variable of a closure."""

    def __init__(self):
        super().__init__()
        total = 0.0

        def summed(value):
            nonlocal total
            total += value
            return total

        self.summed = summed

    def _reward_policy(self):
        return self.summed(self.state[0])


class BufferInside(Drawing):
    """An array deep inside of an object."""

    def __init__(self):
        super().__init__()
        self.parts = {"history": [np.zeros(3)]}

    def _get_info(self):
        history = self.parts["history"][0]
        history[:-1] = history[1:]
        history[-1] = self.state[0]
        return {"oldest": float(history[0])}


STATEFUL = {Filtering: "low_pass", CountingInClosure: "summed", BufferInside: "parts"}


@pytest.mark.parametrize("cls", STATEFUL)
@pytest.mark.parametrize("hooks", ["auto", "per_env"])
def test_objects_with_a_state_belong_to_one_environment_each(cls, hooks):
    require_pair_equal(cls, steps=30, hooks=hooks)


@pytest.mark.parametrize("cls", STATEFUL)
def test_they_are_found_and_named(cls):
    with pytest.raises(ConfigError, match=rf"changes self\.{STATEFUL[cls]}, which belongs in"):
        FMUVectorEnv(cls, 2, hooks="array")


class Remembering(Drawing):
    """A hook leaves what it has read in an object; all else can be compiled."""

    def __init__(self, seen):
        self.seen = seen
        super().__init__()

    def _is_done(self):
        self.seen["last"] = self.state[0]
        self.seen.setdefault("all", []).append(self.state[1])
        return self.state[0] > 100.0


@pytest.mark.parametrize("hooks", ["auto", "array", "compiled"])
def test_checks_and_traces_leave_nothing_in_the_users_objects(hooks):
    seen = {}
    try:
        FMUVectorEnv(lambda: Remembering(seen), 2, hooks=hooks).close()
    except ConfigError:
        assert hooks != "auto"
    assert seen == {}


@pytest.mark.parametrize("hooks", ["array", "per_env"])
def test_methods_that_were_read_before_read_the_present_values(hooks, make_envs):
    vector = make_envs(WithCost, 3, hooks=hooks)
    vector.reset(seed=2)
    methods = vector.get_attr("_reward_policy")
    vector.step(np.zeros((3, 1), np.float32))
    expected = [-state[0] * state[0] for state in vector.get_attr("state")]
    assert [method() for method in methods] == expected
    assert list(vector.call("cost")) == [-value for value in expected]


class TestContents:
    """What hooks change is found, and undone."""

    def make(self, **attributes):
        env = Drawing()
        vars(env).update(attributes)
        return env

    @pytest.mark.parametrize(
        ("value", "change"),
        [
            ([1, [2]], lambda value: value[1].append(3)),
            ({"a": {1}}, lambda value: value["a"].add(2)),
            (bytearray(b"x"), lambda value: value.extend(b"y")),
            (np.zeros(2), lambda value: value.fill(1.0)),
            (np.random.default_rng(1), lambda value: value.random()),
            (LowPass(), lambda value: value(1.0)),
            ((LowPass(),), lambda value: value[0](1.0)),
            (LowPass().__call__, lambda value: value(1.0)),
            (functools.partial(LowPass()), lambda value: value(1.0)),
        ],
    )
    def test_of_all_kinds(self, value, change):
        env = self.make(held=value)
        contents = Contents(env)
        assert contents.changes().inside is None
        change(value)
        assert contents.changes().inside == "held"
        assert contents.changed_in_place() == {"held"}
        contents.restore()
        assert contents.changes().inside is None
        assert env.held is value
        env.close()

    def test_new_attributes(self):
        env = self.make()
        contents = Contents(env)
        env.new = 1
        assert contents.changes().inside == "new"
        contents.restore()
        assert not hasattr(env, "new")
        env.close()

    def test_what_leads_back_to_itself(self):
        loop = []
        loop.append(loop)
        env = self.make(loop=loop)
        env.me = env
        contents = Contents(env)
        loop.append(1)
        assert contents.changes().inside == "loop"
        contents.restore()
        assert len(loop) == 1
        env.close()


def test_observations_of_one_environment_after_another_are_new_arrays(make_envs):
    """A caller may write to what a step has returned, and reset some environments afterwards."""
    envs = make_envs(Drawing, 3, hooks="per_env", autoreset_mode="disabled")
    envs.reset(seed=0)
    observations = envs.step(envs.action_space.sample())[0]
    before = observations.copy()
    observations[:] = 99.0
    again, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(again[[0, 2]], before[[0, 2]])
    assert (again[1] != before[1]).all()
    assert (np.abs(again) < 2.0).all()


FILTER, RECORD, STEPS = LowPass(), [], 0


class SharedFilter(Drawing):
    """Its reward is that of a filter outside of it."""

    def _reward_policy(self):
        return FILTER(self.state[0])


class Recording(Drawing):
    """Adds to a list outside of it."""

    def _reward_policy(self):
        RECORD.append(self.state[0])
        return self.state[0]


class Stepping(Drawing):
    """Counts in a global variable."""

    def _reward_policy(self):
        global STEPS
        STEPS += 1
        return 1.0 * STEPS


@pytest.mark.parametrize("task", [SharedFilter, Recording, Stepping])
def test_making_a_vector_environment_leaves_nothing_outside_of_it(task, make_envs):
    FILTER.value, globals()["STEPS"] = 0.25, 0
    make_envs(task, 3)
    assert (FILTER.value, RECORD, STEPS) == (0.25, [], 0)


@pytest.mark.parametrize("task", [SharedFilter, Stepping])
def test_what_all_environments_share_is_found(task, make_envs):
    with pytest.raises(ConfigError, match="_reward_policy changes"):
        FMUVectorEnv(task, 3, hooks="array")
    envs = make_envs(task, 3)
    envs.reset(seed=0)
    before = FILTER.value
    rewards = envs.step(np.zeros((3, 1), np.float32))[1]
    assert len(set(rewards.tolist())) == 3
    expected = before
    for state in envs.get_attr("state"):
        expected += 0.1 * (state[0] - expected)
    assert task is Stepping or FILTER.value == rewards[-1] == expected


DATA = {"large": np.zeros(100_000), "small": np.zeros(3), "many": [[0.0] for _ in range(5000)]}


class Reading(Drawing):
    """Reads data outside of it."""

    def _reward_policy(self):
        return self.state[0] + DATA["small"][0]


def test_large_data_outside_is_not_copied():
    with Reading() as env:
        kept = [one.value for one in Contents(env, outside=True)._kept]
    assert any(value is DATA["small"] for value in kept)
    assert not any(value is DATA["large"] or value is DATA["many"] for value in kept)
