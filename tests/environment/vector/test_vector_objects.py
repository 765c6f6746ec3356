"""Functions and objects that environments hold in attributes, called by their hooks."""

import functools

import numpy as np
import pytest
from vector_tools import Drawing, require_pair_equal
from ways import in_way


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


@pytest.mark.parametrize("cls", [WithCost, Judged])
@pytest.mark.parametrize("hooks", ["arrays", "one by one"])
def test_functions_and_objects_that_refer_to_the_environment(cls, hooks):
    require_pair_equal(cls, steps=30, way=hooks)


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


def test_an_object_with_a_state_belongs_to_one_environment():
    require_pair_equal(Filtering, steps=30, way="one by one")


@pytest.mark.parametrize("hooks", ["arrays", "one by one"])
def test_methods_that_were_read_before_read_the_present_values(hooks, make_envs):
    vector = make_envs(in_way(hooks, WithCost), 3)
    vector.reset(seed=2)
    methods = vector.get_attr("_reward_policy")
    vector.step(np.zeros((3, 1), np.float32))
    expected = [-state[0] * state[0] for state in vector.get_attr("state")]
    assert [method() for method in methods] == expected
    assert list(vector.call("cost")) == [-value for value in expected]


def test_observations_of_one_environment_after_another_are_new_arrays(make_envs):
    """A caller may write to what a step has returned, and reset some environments afterwards."""
    envs = make_envs(in_way("one by one", Drawing), 3, autoreset_mode="disabled")
    envs.reset(seed=0)
    observations = envs.step(envs.action_space.sample())[0]
    before = observations.copy()
    observations[:] = 99.0
    again, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(again[[0, 2]], before[[0, 2]])
    assert (again[1] != before[1]).all()
    assert (np.abs(again) < 2.0).all()
