"""The form of infos is that of Gymnasium's vector environments, whichever way leads into it."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vector_tools import require_same_infos

from fmugym import ConfigError
from fmugym.environment.vector.infos import gathered, handed_out

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
