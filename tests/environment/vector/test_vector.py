"""Vector environments: each environment in them is what it is alone."""

import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector_tools import (
    CART_POLE,
    HOOKS,
    IDS,
    Drawing,
    each_mode,
    each_way,
    in_each_mode,
    require_equal,
    results_of_both,
    run_side_by_side,
    sampled_actions,
)
from ways import in_way, make_vec

from fmugym import ConfigError, SimulationError
from fmugym.environment.vector import FMUVectorEnv


@in_each_mode({"env_id": IDS})
def test_each_environment_is_what_it_is_alone(env_id, mode, hooks):
    options = {"max_episode_steps": 25}
    ours = make_vec(hooks, env_id, num_envs=5, autoreset_mode=mode, **options)
    theirs = SyncVectorEnv([lambda: gym.make(env_id, **options)] * 5, autoreset_mode=mode)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space.contains(ours.reset(seed=1)[0])
    rtol = 1e-7 if "Pendulum" in env_id else 0.0  # numpy's powers of arrays and of scalars
    assert run_side_by_side(ours, theirs, 120, rtol=rtol) >= 20


@each_mode
def test_threads_change_nothing(mode):
    options = {"max_episode_steps": 7, "autoreset_mode": mode}
    ours, theirs = (FMUVectorEnv(CART_POLE, 2000, threads=n, **options) for n in (1, 4))
    assert run_side_by_side(ours, theirs, 25) > 2000


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
@pytest.mark.parametrize(
    ("num_envs", "way"), [(1, "sync"), (2, "async"), (7, "sync"), (64, "sync")]
)
def test_any_number_of_environments_in_gymnasiums_own_ways(num_envs, way):
    ours = gym.make_vec("fmugym/CartPole-v0", num_envs=num_envs)
    theirs = gym.make_vec("fmugym/CartPole-v0", num_envs=num_envs, vectorization_mode=way)
    assert run_side_by_side(ours, theirs) > 0


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*:DeprecationWarning")
def test_figures_of_a_task_file_come_out_of_gymnasiums_own_processes(tmp_path):
    path = tmp_path / "task.toml"
    path.write_text(
        """
        fmu = { bundled = "Pendulum" }
        time_step = "50ms"
        episode_length = "0.5s"
        reward = "-abs(q)"
        parameters = { q_0 = { distribution = "uniform", low = -1, high = 1 } }
        agent = { actions = ["tau"], observations = ["q"] }
        kpis = { worst = { max = "abs(q)" } }
        """
    )
    ours, theirs = (
        gym.make_vec("fmugym/FMU-v0", 2, vectorization_mode=way, config=str(path))
        for way in ("vector_entry_point", "async")
    )
    for result in results_of_both(ours, theirs, 9):
        worst = result[4]["kpis"]["worst"]
        assert (worst > np.abs(result[0][:, 0]) - 1e-6).all()
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


@each_way
def test_the_seeds_can_be_read(hooks):
    """As in Gymnasium's SyncVectorEnv; after a reset without a seed they stay."""
    envs = make_vec(hooks, "fmugym/CartPole-v0", num_envs=3)
    envs.reset(seed=9)
    assert envs.np_random_seed == (9, 10, 11)
    envs.reset()
    assert envs.np_random_seed == (9, 10, 11)
    envs.reset(seed=[4, None, 6])
    assert envs.np_random_seed == (4, 10, 6)
    envs.close()
    fresh = make_vec(hooks, "fmugym/CartPole-v0", num_envs=2)
    first = fresh.np_random_seed
    fresh.reset()
    assert fresh.np_random_seed == first
    assert first[0] != first[1]
    fresh.close()


# Modes of autoreset, and limits of episodes


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
