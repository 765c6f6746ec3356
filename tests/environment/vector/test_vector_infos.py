"""Infos and results of vector environments belong to the caller."""

from collections.abc import Mapping

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import given, settings
from hypothesis import strategies as st
from vector_tools import (
    CART_POLE,
    Remembering,
    each_way,
    in_each_mode,
    require_same_infos,
    sampled_actions,
)
from ways import in_way, make_vec

from fmugym import ConfigError
from fmugym.environment.vector.infos import gathered, handed_out


@each_way
def test_infos_as_lists(hooks):
    vector = make_vec(hooks, "fmugym/CartPole-v0", num_envs=2)
    wrapped = gym.wrappers.vector.DictInfoToList(vector)
    _, infos = wrapped.reset(seed=0)
    assert [sorted(info["drawn"]) for info in infos] == [
        ["phi_0", "phi_dot_0", "x_0", "x_dot_0"]
    ] * 2
    drawn = []
    for actions in sampled_actions(vector, 60):
        *_, infos = wrapped.step(actions)
        drawn += [info["drawn"]["x_0"] for info in infos if "drawn" in info]
    assert len(set(drawn)) > 2
    wrapped.close()


def require_zero_outside_of_masks(infos):
    for name, mask in infos.items():
        values = infos.get(name[1:])
        if not name.startswith("_") or values is None:
            continue
        if isinstance(values, Mapping):
            require_zero_outside_of_masks(values)
        elif values.dtype == object:
            assert all(value is None for value in values[~mask]), name
        else:
            empty = np.isnan if name == "_final_obs" else np.logical_not
            assert empty(values[~mask]).all(), name


@in_each_mode({"cls": [Remembering, CART_POLE]})
def test_infos_are_zero_outside_of_their_masks(cls, mode, hooks, make_envs):
    vector = make_envs(in_way(hooks, cls), 4, autoreset_mode=mode)
    require_zero_outside_of_masks(vector.reset(seed=0)[1])
    told = 0
    for actions in sampled_actions(vector, 40):
        result = vector.step(actions)
        ended = result[2] | result[3]
        infos = result[4]
        if mode is AutoresetMode.DISABLED and ended.any():
            infos = vector.reset(options={"reset_mask": ended})[1]
        require_zero_outside_of_masks(infos)
        told += "drawn" in infos and not infos["_drawn"].all()
    assert told > 0


COUNT = 4
KINDS = {
    "integer": st.integers(-100, 100),
    "number": st.floats(-1e6, 1e6),
    "flag": st.booleans(),
    "single": st.floats(-100.0, 100.0, width=32).map(np.float32),
    "numpy flag": st.booleans().map(np.bool_),
    "text": st.text(max_size=3),
    "array": st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=2).map(np.array),
}
FLAT = st.fixed_dictionaries({}, optional=KINDS)
NESTED = st.fixed_dictionaries({}, optional=KINDS | {"inner": FLAT})
INFOS = st.dictionaries(st.integers(0, COUNT - 1), NESTED)


class Telling(gym.Env):
    """Has nothing but an info."""

    observation_space = action_space = gym.spaces.Discrete(1)

    def reset(self, *, seed=None, options=None):
        return 0, self.info


def by_gymnasium(infos):
    envs = gym.vector.SyncVectorEnv([Telling] * COUNT)
    for index, env in enumerate(envs.envs):
        env.info = infos.get(index, {})
    return envs.reset()[1]


@settings(max_examples=70, deadline=None)
@given(INFOS)
def test_gathered_as_gymnasium_does(infos):
    ours, theirs = gathered(dict(sorted(infos.items())), COUNT), by_gymnasium(infos)
    assert list(ours) == list(theirs)
    require_same_infos(ours, theirs)


@settings(max_examples=70, deadline=None)
@given(INFOS)
def test_handed_out_again(infos):
    into = [{} for _ in range(COUNT)]
    handed_out(gathered(infos, COUNT), into)
    for index, info in enumerate(into):
        expected = infos.get(index, {})
        assert info.keys() == expected.keys()
        for name, value in info.items():
            require_equal_parts(value, expected[name])


def require_equal_parts(value, expected):
    if isinstance(expected, dict):
        assert value.keys() == expected.keys()
        for name in expected:
            require_equal_parts(value[name], expected[name])
    else:
        np.testing.assert_array_equal(value, expected)


@pytest.mark.parametrize(
    ("first", "second"),
    [(1.0, "a"), (np.zeros(2), np.zeros(3)), ({"a": 1}, 2), (1.0, {"a": 1}), (np.zeros(2), "x")],
)
def test_values_that_do_not_fit_are_named(first, second):
    with pytest.raises(ConfigError, match=r"environment 3: its info does not fit .*'odd' is"):
        gathered({1: {"odd": first}, 3: {"odd": second}}, COUNT)
