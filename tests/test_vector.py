"""Vector environments: each environment in them is what it is alone."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_tools import (
    IDS,
    each_mode,
    each_way,
    make_pair,
    require_equal,
    run_side_by_side,
    sampled_actions,
)

import fmugym


@each_way
@each_mode
@pytest.mark.parametrize("env_id", IDS)
def test_each_environment_is_what_it_is_alone(env_id, mode, hooks):
    options = {"max_episode_steps": 25}
    ours = gym.make_vec(env_id, num_envs=5, autoreset_mode=mode, hooks=hooks, **options)
    theirs = SyncVectorEnv([lambda: gym.make(env_id, **options)] * 5, autoreset_mode=mode)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is mode
    rtol = 1e-7 if "Pendulum" in env_id else 0.0  # numpy's powers of arrays and of scalars
    ends = run_side_by_side(ours, theirs, mode, 120, rtol=rtol)
    assert ends >= 20
    assert ours.observation_space.contains(ours.reset(seed=1)[0])
    ours.close()
    theirs.close()


@pytest.mark.parametrize("fmi_version", ["1.0", "3.0"])
def test_other_fmi_versions(fmi_version):
    ours, theirs = make_pair(fmugym.envs.CartPoleEnv, fmi_version=fmi_version)
    assert run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 100) > 5
    ours.close()
    theirs.close()


@pytest.mark.parametrize("num_envs", [1, 2, 7, 64])
def test_any_number_of_environments(num_envs):
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=num_envs)
    theirs = gym.make_vec("fmugym/CartPole-v0", num_envs=num_envs, vectorization_mode="sync")
    assert run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 60) > 0
    ours.close()
    theirs.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_equal_to_gymnasiums_cart_poles_over_many_episodes(mode):
    """The streams of 40 episodes and more: values drawn ahead are used up and drawn again.

    Then two of the three are seeded anew.
    """
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=3, autoreset_mode=mode)
    theirs = gym.make_vec(
        "CartPole-v1",
        num_envs=3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
    )
    for seed in (7, [8, None, 9]):
        first, second = ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0]
        ends = 0
        for actions in sampled_actions(ours, 1500):
            require_equal(first, second)
            first, *ours_said, _ = ours.step(actions)
            second, *they_said, _ = theirs.step(actions)
            require_equal(np.array(ours_said), np.array(they_said))
            ends += int((ours_said[1] | ours_said[2]).sum())
        assert ends > 120
    ours.close()
    theirs.close()


def test_equal_to_gymnasiums_own_vector_environment_from_one_state():
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=8)
    theirs = gym.make_vec("CartPole-v1", num_envs=8, vectorization_mode="vector_entry_point")
    theirs.reset(seed=1)
    ours.reset(seed=1)
    theirs.unwrapped.state = ours.get_attr("state")
    theirs.unwrapped.state = np.array(theirs.unwrapped.state).T
    for actions in sampled_actions(ours, 8):
        a, b = ours.step(actions), theirs.step(actions)
        require_equal(a[0], b[0])
        assert a[1].tolist() == b[1].tolist()
        assert a[2].tolist() == b[2].tolist()
    ours.close()
    theirs.close()


def test_a_thousand_environments_equal_single_ones():
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=1000)
    first, _ = vector.reset(seed=5)
    chosen = (0, 499, 999)
    singles = [gym.make("fmugym/CartPole-v0") for _ in chosen]
    for single, index in zip(singles, chosen, strict=True):
        assert single.reset(seed=5 + index)[0].tolist() == first[index].tolist()
    ended = np.zeros(1000, bool)
    for actions in sampled_actions(vector, 40):
        observations, *_ = result = vector.step(actions)
        for single, index in zip(singles, chosen, strict=True):
            alone = single.reset()[0] if ended[index] else single.step(actions[index])[0]
            assert alone.tolist() == observations[index].tolist()
        ended = result[2] | result[3]
    assert ended.any()
    vector.close()
    for single in singles:
        single.close()


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
@pytest.mark.parametrize("vectorization_mode", ["sync", "async"])
def test_gymnasiums_own_ways(vectorization_mode):
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=2)
    theirs = gym.make_vec("fmugym/CartPole-v0", num_envs=2, vectorization_mode=vectorization_mode)
    assert run_side_by_side(ours, theirs, AutoresetMode.NEXT_STEP, 60) > 2
    ours.close()
    theirs.close()


def test_thousands_in_one_call():
    vector = gym.make_vec("fmugym/CartPole-v0", num_envs=4096)
    vector.reset(seed=0)
    for actions in sampled_actions(vector, 20):
        observations, rewards, *_ = vector.step(actions)
    assert observations.shape == (4096, 4)
    assert rewards.shape == (4096,)
    vector.close()


@pytest.mark.parametrize("hooks", ["auto", "array", "per_env"])
def test_the_seeds_can_be_read(hooks):
    """As in Gymnasium's SyncVectorEnv; after a reset without a seed they stay."""
    envs = gym.make_vec("fmugym/CartPole-v0", num_envs=3, hooks=hooks)
    envs.reset(seed=9)
    assert envs.np_random_seed == (9, 10, 11)
    envs.reset()
    assert envs.np_random_seed == (9, 10, 11)
    envs.reset(seed=[4, None, 6])
    assert envs.np_random_seed == (4, 10, 6)
    envs.close()
    fresh = gym.make_vec("fmugym/CartPole-v0", num_envs=2, hooks=hooks)
    first = fresh.np_random_seed
    fresh.reset()
    assert fresh.np_random_seed == first
    assert first[0] != first[1]
    fresh.close()
