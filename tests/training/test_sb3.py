"""Stable-Baselines3 trains on the environments as it does on single ones, only faster."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

import fmugym
from fmugym import ConfigError, FMUVectorEnv, Uniform
from fmugym.envs import CartPoleEnv, PendulumEnv

sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra test-sb3")
# ruff: noqa: E402  (what follows needs SB3)

import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecMonitor,
    is_vecenv_wrapped,
)

from fmugym.training.sb3 import FMUVecEnv, make_sb3_env

IDS = ["fmugym/CartPole-v0", "fmugym/Pendulum-v0", "fmugym/ModelicaCartPole-v0"]
TWINS = {"fmugym/CartPole-v0": "CartPole-v1", "fmugym/Pendulum-v0": "Pendulum-v1"}


class Reaching(fmugym.FMI2CSEnv):
    """A goal task with dict observations, an info, and something to set."""

    def __init__(self):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": Uniform(-1, 1), "m": 0.06},
            "time_step": 0.02,
            "episode_variables": {"target": Uniform(-0.5, 0.5)},
            "max_episode_steps": 20,
            "bounds": {"tau": (-0.03, 0.03)},
        }
        super().__init__(fmugym.bundled_fmu("Pendulum"), config)
        self.tolerance = 0.01

    def _get_observation_space(self):
        names = ("observation", "achieved_goal", "desired_goal")
        boxes = [spaces.Box(-np.inf, np.inf, (n,), np.float32) for n in (2, 1, 1)]
        return spaces.Dict(dict(zip(names, boxes, strict=True)))

    def _get_observation(self):
        q, q_dot = self.state
        return {
            "observation": np.array([q, q_dot], np.float32),
            "achieved_goal": np.array([q], np.float32),
            "desired_goal": np.array([self.variables["target"]], np.float32),
        }

    def _goal_reward(self, achieved_goal, desired_goal):
        return -np.abs(achieved_goal - desired_goal).sum(axis=-1)

    def _get_info(self):
        return {"speed": abs(self.state[1])}

    def _is_done(self):
        q, _ = self.state
        return abs(q - self.variables["target"]) < self.tolerance

    def loosen(self, factor):
        self.tolerance *= factor
        return self.tolerance

    def aim(self, target):
        self.variables["target"] = target


class OneByOne(CartPoleEnv):
    """Its hook does not work on arrays."""

    def _is_done(self):
        x, _, theta, _ = self.state
        return bool(abs(x) > 0.3 or abs(theta) > 0.1)


@pytest.fixture(scope="module", autouse=True)
def fixture_one_thread():
    """PyTorch's threads are no help for small networks, and a hindrance on a busy machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(name="make")
def fixture_make(opened):
    """Make environments for SB3 that are closed after the test."""

    def make(env="fmugym/CartPole-v0", num_envs=3, **kwargs):
        return opened(make_sb3_env(env, num_envs, **{"monitor": False, **kwargs}))

    return make


def singles(env, count, **kwargs):
    """The same environments as SB3 itself steps them."""
    make = (lambda: gym.make(env, **kwargs)) if isinstance(env, str) else env
    return DummyVecEnv([make] * count)


def assert_same(ours, theirs):
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        for key, value in theirs.items():
            assert_same(ours[key], value)
    elif isinstance(theirs, list):
        assert len(ours) == len(theirs)
        for mine, other in zip(ours, theirs, strict=True):
            assert_same(mine, other)
    else:
        assert type(ours) is type(theirs)
        np.testing.assert_array_equal(ours, theirs, strict=True)


@pytest.mark.parametrize("env_id", IDS)
def test_sb3s_own_checker_passes_and_warns_of_nothing_more_than_for_gymnasiums_own(env_id):
    def complaints(name):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            env = gym.make(name)
            check_env(env, skip_render_check=True)
            env.close()
        return [str(warning.message) for warning in caught]

    assert complaints(env_id) == (complaints(TWINS[env_id]) if env_id in TWINS else [])


@pytest.mark.parametrize("overlap", [False, True], ids=["in_turn", "overlap"])
@pytest.mark.parametrize("env", [*IDS, Reaching, OneByOne], ids=str)
def test_it_is_the_equal_of_single_environments_in_sb3s_dummy_vec_env(env, overlap, make):
    ours, theirs = make(env, 4, overlap=overlap), singles(env, 4)
    assert (ours.observation_space, ours.action_space) == (
        theirs.observation_space,
        theirs.action_space,
    )
    assert ours.seed(7) == theirs.seed(7)
    assert_same(ours.reset(), theirs.reset())
    assert_same(ours.reset_infos, theirs.reset_infos)
    ours.action_space.seed(1)
    ended = 0
    for _ in range(450):
        actions = np.array([ours.action_space.sample() for _ in range(4)])
        result, expected = ours.step(actions), theirs.step(actions)
        for mine, other in zip(result, expected, strict=True):
            assert_same(mine, other)
        assert_same(ours.reset_infos, theirs.reset_infos)
        ended += result[2].sum()
    assert ended >= 8
    theirs.close()


def test_an_episode_that_ends_by_itself_in_the_last_step_is_not_cut_short(make):
    class FallsAtTen(CartPoleEnv):
        def _is_done(self):
            return self.step_count >= 10

    venv = make(FallsAtTen, max_episode_steps=10)
    venv.reset()
    for _ in range(10):
        _, _, dones, infos = venv.step(np.zeros(3, np.int64))
    assert dones.all()
    assert not any(info["TimeLimit.truncated"] for info in infos)


def test_what_it_hands_out_stays_as_it_was(make):
    venv = make()
    venv.reset()
    first = venv.step(np.zeros(3, np.int64))
    copies = [first[0].copy(), first[1].copy()]
    first[3][0]["mine"] = 1
    second = venv.step(np.ones(3, np.int64))
    assert_same(list(first[:2]), copies)
    assert "mine" not in second[3][0]
    assert len({id(info) for info in second[3]}) == 3


def test_seeds_are_used_once_and_make_runs_the_same(make):
    venv = make(seed=5)
    first = venv.reset()
    assert not np.array_equal(venv.reset(), first)
    venv.seed(5)
    assert_same(venv.reset(), first)
    assert_same(make(seed=6, num_envs=2).reset(), first[1:])


def test_options_for_all_and_for_each(make):
    venv, other = make("fmugym/Pendulum-v0"), singles("fmugym/Pendulum-v0", 3)
    options = {"x_init": 0.01, "y_init": 0.01}
    for choice in (options, [options, {}, {"x_init": 0.5, "y_init": 0.1}], None):
        observations = []
        for env in (venv, other):
            env.seed(2)
            env.set_options(choice)
            observations.append(env.reset())
        assert_same(*observations)
        assert_same(venv.reset_infos, other.reset_infos)
    assert_same(venv.reset(), other.reset())
    other.close()


def test_attributes_of_all_and_of_some(make):
    venv = make()
    venv.reset()
    assert venv.get_attr("x_threshold") == [2.4, 2.4, 2.4]
    venv.set_attr("x_threshold", 1.0, indices=[0, -1])
    assert venv.get_attr("x_threshold") == [1.0, 2.4, 1.0]
    venv.set_attr("x_threshold", 2.0)
    assert venv.get_attr("x_threshold", indices=1) == [2.0]
    assert venv.get_attr("render_mode") == [None] * 3
    assert venv.has_attr("force_mag")
    assert not venv.has_attr("no_such_thing")
    with pytest.raises(IndexError):
        venv.get_attr("x_threshold", indices=3)
    with pytest.raises(AttributeError):
        venv.set_attr("no_such_thing", 1, indices=0)


def test_an_attribute_that_was_set_is_what_the_hooks_use(make):
    venv = make()
    venv.set_attr("x_threshold", 0.0, indices=1)
    venv.reset()
    assert venv.step(np.zeros(3, np.int64))[2].tolist() == [False, True, False]


def test_parameters_of_all_and_of_some_take_effect_with_the_next_episode(make):
    venv = make()
    venv.seed(0)
    venv.reset()
    venv.set_attr("m_pole", 0.2, indices=0)
    venv.set_attr("m_pole", 0.3, indices=[2])
    assert venv.get_attr("m_pole") == [0.1, 0.1, 0.1]
    venv.reset()
    assert venv.get_attr("m_pole") == [0.2, 0.1, 0.3]
    venv.set_attr("m_pole", 0.4)
    venv.reset()
    assert venv.get_attr("m_pole") == [0.4] * 3
    venv.set_attr("max_step", 0.01, indices=1)  # of the FMU's own start value for the others
    venv.reset()
    assert venv.get_attr("max_step") == [1.0, 0.01, 1.0]


def test_a_drawn_parameter_cannot_be_set_for_some_only(make):
    venv = make()
    with pytest.raises(ConfigError, match="'x_0' is drawn in each episode"):
        venv.set_attr("x_0", 0.0, indices=1)
    venv.set_attr("x_0", 0.0)
    assert venv.reset()[:, 0].tolist() == [0.0] * 3


def test_methods_of_all_and_of_some_keep_what_they_write(make):
    venv = make(Reaching)
    venv.seed(0)  # no pendulum starts where it is done in the first step
    venv.reset()
    assert venv.env_method("loosen", 2.0) == [0.02] * 3
    assert venv.env_method("loosen", factor=10.0, indices=[1]) == [0.2]
    assert venv.get_attr("tolerance") == [0.02, 0.2, 0.02]
    venv.env_method("aim", 0.4, indices=2)
    assert venv.get_attr("variables")[2] == {"target": 0.4}
    observations, *_ = venv.step(np.zeros((3, 1), np.float32))
    assert observations["desired_goal"][2] == np.float32(0.4)
    assert observations["desired_goal"][0] != np.float32(0.4)


def test_methods_that_would_part_an_environment_from_the_others_are_refused(make):
    class Meddling(CartPoleEnv):
        def meddle(self):
            self.config = None

    venv = make(Meddling)
    venv.reset()
    for method in ("reset", "step", "close"):
        with pytest.raises(ConfigError, match=method):
            venv.env_method(method)
    venv.step(np.zeros(3, np.int64))
    with pytest.raises(ConfigError, match="'config'"):
        venv.env_method("meddle")


def test_single_environments_that_are_real_ones_do_their_methods_themselves(make):
    class Slow(OneByOne):
        def widen(self):
            self.variables["x_threshold"] += 1

    venv = make(Slow)
    venv.reset()
    venv.env_method("widen", indices=[0])
    assert venv.get_attr("x_threshold") == [3.4, 2.4, 2.4]


def test_pictures(make):
    venv = make(num_envs=4, render_mode="rgb_array")
    venv.reset()
    assert [picture.shape for picture in venv.get_images()] == [(400, 600, 3)] * 4
    assert venv.render().shape == (800, 1200, 3)
    assert [p.shape for p in venv.env_method("render", indices=[1, 2])] == [(400, 600, 3)] * 2
    assert venv.metadata["render_fps"] == 50
    blind = make()
    with pytest.warns(UserWarning, match="no pictures"):
        assert blind.get_images() == [None] * 3


def test_only_vector_environments_of_fmugym_in_the_right_mode_are_taken(make_envs):
    with pytest.raises(ConfigError, match="CartPole-v1"):
        make_sb3_env("CartPole-v1")
    with pytest.raises(ConfigError, match="got SyncVectorEnv"):
        FMUVecEnv(gym.make_vec("fmugym/CartPole-v0", 2, vectorization_mode="sync"))
    env = make_envs(CartPoleEnv, 2)
    with pytest.raises(ConfigError, match="NEXT_STEP, expected SAME_STEP"):
        FMUVecEnv(env)


def test_a_vector_environment_of_ones_own_and_an_id_with_a_module(make):
    env = FMUVectorEnv(lambda: PendulumEnv(g=9.81), 2, autoreset_mode="same_step")
    venv = FMUVecEnv(env)
    assert venv.vector_env is env
    venv.reset()
    assert venv.get_attr("g") == [9.81] * 2
    venv.close()
    assert make("fmugym:fmugym/CartPole-v0").spec.id == "fmugym/CartPole-v0"


def test_monitor_is_that_of_vector_environments(make):
    env = make("fmugym/CartPole-v0", monitor=True)
    assert is_vecenv_wrapped(env, VecMonitor)
    assert env.env_is_wrapped(Monitor) == [False] * 3


class Recorder(BaseCallback):
    """Counts how often there was something to bootstrap from."""

    truncated = 0

    def _on_step(self):
        self.truncated += sum(info["TimeLimit.truncated"] for info in self.locals["infos"])
        return True


def small(**arguments):
    return {"policy_kwargs": {"net_arch": [16]}, "device": "cpu", "seed": 3, **arguments}


def weights(model):
    return [value.numpy() for value in model.policy.state_dict().values()]


def test_ppo_learns_the_same_as_on_single_environments(make):
    trained = []
    overlapping = make(num_envs=4, overlap=True)
    for env in (make(num_envs=4), overlapping, singles("fmugym/CartPole-v0", 4)):
        model = sb3.PPO("MlpPolicy", env, **small(n_steps=32, batch_size=64, n_epochs=2))
        trained.append(weights(model.learn(512)))
        env.close()
    assert_same(trained[0], trained[1])
    assert_same(trained[0], trained[2])


def test_sac_learns_the_same_as_on_single_environments(make):
    trained = []
    for env in (make("fmugym/Pendulum-v0", 2), singles("fmugym/Pendulum-v0", 2)):
        recorder = Recorder()
        model = sb3.SAC("MlpPolicy", env, **small(learning_starts=64, batch_size=32))
        trained.append(weights(model.learn(450, callback=recorder)))
        assert recorder.truncated == 2
        env.close()
    assert_same(*trained)


def test_hindsight_replay_asks_a_goal_task_for_rewards(make):
    venv = make(Reaching, 2, monitor=True)
    model = sb3.SAC(
        "MultiInputPolicy",
        venv,
        replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 2},
        **small(learning_starts=80, batch_size=32),
    )
    model.learn(200)
    mean, _ = evaluate_policy(model, venv, n_eval_episodes=2)
    assert np.isfinite(mean)


def test_a_model_is_saved_loaded_and_goes_on(make, tmp_path):
    model = sb3.PPO("MlpPolicy", make(), **small(n_steps=32, batch_size=32)).learn(96)
    model.save(tmp_path / "model")
    loaded = sb3.PPO.load(tmp_path / "model", env=make(), device="cpu")
    assert_same(weights(loaded), weights(model))
    assert loaded.learn(96, reset_num_timesteps=False).num_timesteps == 192


@pytest.mark.parametrize("env", [None, 3, "nothing/Nothing-v0", "no_module:No-v0", "a b"])
def test_environments_that_do_not_exist(env):
    with pytest.raises(ConfigError):
        make_sb3_env(env)


@pytest.mark.parametrize("seed", [-1, 1.5, "1", True])
def test_seeds_that_do_not_fit(seed):
    with pytest.raises(ConfigError, match="seed"):
        make_sb3_env(CartPoleEnv, 2, seed=seed)
