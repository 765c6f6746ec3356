"""Resets of some environments, the modes of autoreset, and limits of episodes."""

import numpy as np
import pytest
from combinations import in_turn
from vector_tools import HOOKS, Drawing, each_way, sampled_actions
from ways import in_way

from fmugym import ConfigError, SimulationError


def test_the_first_reset_is_of_all(make_envs):
    vector = make_envs(Drawing, 2)
    with pytest.raises(ConfigError, match="first reset must be of all"):
        vector.reset(options={"reset_mask": np.array([True, False])})


@each_way
def test_disabled_autoreset_wants_a_reset(hooks, make_envs):
    vector = make_envs(in_way(hooks, Drawing), 2, autoreset_mode="disabled")
    vector.reset(seed=0)
    actions = sampled_actions(vector, 4)
    for action in actions[:3]:
        vector.step(action)
    with pytest.raises(SimulationError, match="environment 0 has ended"):
        vector.step(actions[3])
    vector.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(SimulationError, match="environment 1 has ended"):
        vector.step(actions[3])
    vector.reset(options={"reset_mask": np.array([False, True])})
    vector.step(actions[3])


@in_turn({"own,given,expected": [(3, None, 3), (8, 4, 4), (2, 9, 2)], "hooks": HOOKS})
def test_truncation_at_the_smaller_limit(own, given, expected, hooks, make_envs):
    vector = make_envs(
        in_way(hooks, lambda: Drawing(max_episode_steps=own)),
        3,
        max_episode_steps=given,
    )
    vector.reset(seed=0)
    for _ in range(3):  # episodes
        said = [vector.step(action)[3].tolist() for action in sampled_actions(vector, expected)]
        assert said == [[False] * 3] * (expected - 1) + [[True] * 3]
        vector.step(sampled_actions(vector, 1)[0])


@each_way
def test_the_reset_step_does_not_step_the_fmu(hooks, make_env, make_envs):
    """The probe FMU counts its steps."""
    vector = make_envs(
        in_way(hooks, lambda: make_env(model_output_names=["steps", "sum"], max_episode_steps=2)),
        2,
    )
    vector.reset()
    counts, rewards = [], []
    for _ in range(7):
        observations, reward, *_ = vector.step(np.ones((2, 1), np.float32))
        counts.append(observations[1, 0])
        rewards.append(reward[1])
    assert counts == [1, 2, 0, 1, 2, 0, 1]
    assert rewards == [1, 1, 0, 1, 1, 0, 1]
