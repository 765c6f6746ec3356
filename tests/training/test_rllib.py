"""RLlib's env runners step vector environments, on any node of a Ray cluster."""

import logging
import pickle
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import fmugym
from fmugym import ConfigError, bundled_fmu
from fmugym.envs import PendulumEnv

EXAMPLE = Path(__file__).parents[2] / "examples" / "train_rllib.py"
pytest.importorskip("ray.rllib", reason="needs RLlib: the extra rllib")
pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own, and those of torch

import ray  # noqa: E402
from ray.cluster_utils import Cluster  # noqa: E402
from ray.rllib.algorithms.ppo import PPOConfig  # noqa: E402
from ray.tune.registry import ENV_CREATOR, _global_registry  # noqa: E402

import fmugym.training.rllib  # noqa: E402
from fmugym.training.rllib import RunnerVectorEnv, register_task  # noqa: E402

TASK = """
fmu = "parts/Swing.fmu"
time_step = 0.05
episode_length = "1s"
reward = "-q**2 - tau_wanted"
[variables]
tau = { min = -0.2, max = 0.2 }
[data]
tau_wanted = { file = "wanted.csv", column = "value" }
[agent]
actions = ["tau"]
observations = ["q", "q_dot", "tau_wanted"]
"""
MEMORY = 80 * 2**20  # bytes of Ray's object store, the least that it accepts


def maker_of(*arguments, **kwargs):
    """What Ray hands to the runners, after a journey."""
    register_task("travelling", *arguments, **kwargs)
    return pickle.loads(pickle.dumps(_global_registry.get(ENV_CREATOR, "travelling")))


@pytest.fixture
def task(tmp_path):
    folder = tmp_path / "home"
    (folder / "parts").mkdir(parents=True)
    shutil.copy(bundled_fmu("Pendulum"), folder / "parts" / "Swing.fmu")
    (folder / "wanted.csv").write_text("time,value\n0,0.5\n1,1.5\n")
    (folder / "swing.toml").write_text(TASK)
    return folder / "swing.toml"


class TestSeeds:
    def test_environments_of_a_runner_are_single_ones(self):
        env = maker_of("fmugym/CartPole-v0")({"num_envs": 3})
        assert isinstance(env, RunnerVectorEnv)
        seen, _ = env.reset(seed=7)
        for i in range(3):
            single = gym.make("fmugym/CartPole-v0")
            np.testing.assert_array_equal(single.reset(seed=7 * 3 + i)[0], seen[i])
            single.close()
        env.close()

    def test_runners_share_no_stream(self):
        env = maker_of("fmugym/CartPole-v0")({"num_envs": 4})
        starts = [env.reset(seed=100 + worker)[0] for worker in range(4)]
        assert len(np.unique(np.concatenate(starts), axis=0)) == 16
        env.close()

    def test_a_list_of_seeds_is_taken_as_it_is(self):
        env = maker_of("fmugym/CartPole-v0")({"num_envs": 2})
        first, _ = env.reset(seed=[3, 3])
        np.testing.assert_array_equal(first[0], first[1])
        env.close()


class TestFiles:
    @pytest.mark.parametrize("form", ["text", "path", "task", "config"])
    def test_a_task_file_travels_with_all_that_it_needs(self, task, tmp_path, monkeypatch, form):
        expected = rewards_of(fmugym.load(task))
        given = {"text": str(task), "path": task, "task": fmugym.Task.read(task)}
        maker = (
            maker_of("fmugym/FMU-v0", config=str(task))
            if form == "config"
            else maker_of(given[form])
        )
        task.parent.rename(tmp_path / "gone")
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "other machine"))
        env = maker({"num_envs": 2})
        env.reset(seed=0)
        got = [env.step(np.zeros((2, 1), np.float32))[1] for _ in expected]
        np.testing.assert_array_equal(np.array(got)[:, 1], expected)
        env.close()

    def test_files_that_arguments_name_travel(self, tmp_path, monkeypatch):
        own = tmp_path / "Own.fmu"
        shutil.copy(bundled_fmu("Pendulum"), own)
        maker = maker_of(PendulumFrom, fmu_path=own)
        own.unlink()
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "other machine"))
        env = maker({"num_envs": 2})
        assert env.reset(seed=0)[0].shape == (2, 3)
        env.close()

    def test_runners_of_one_machine_share_the_files(self, task, tmp_path, monkeypatch):
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "cache"))
        maker = maker_of(task)
        for _ in range(2):
            maker({"num_envs": 1}).close()
        unpacked = [file for file in (tmp_path / "cache" / "ray").rglob("*") if file.is_file()]
        assert sorted(file.name for file in unpacked) == ["Swing.fmu", "wanted.csv"]

    def test_too_much_for_ray(self, task, monkeypatch):
        monkeypatch.setattr(fmugym.training.rllib, "_MOST_BYTES", 1000)
        with pytest.raises(ConfigError, match="working_dir"):
            register_task("large", task)

    def test_a_file_that_is_missing(self, task):
        (task.parent / "wanted.csv").unlink()
        with pytest.raises(ConfigError, match=re.escape("wanted.csv")):
            register_task("incomplete", task)


class PendulumFrom(PendulumEnv):
    """An environment that takes the path of its FMU."""

    def __init__(self, fmu_path, **kwargs):
        assert Path(fmu_path).is_file()
        super().__init__(**kwargs)


def rewards_of(env):
    env.reset(seed=0)
    rewards = [env.step(np.zeros(1, np.float32))[1] for _ in range(5)]
    env.close()
    return rewards


def test_a_name_must_be_a_text():
    with pytest.raises(ConfigError, match="name"):
        register_task(3, "fmugym/CartPole-v0")


def test_single_environments_are_made_with_advice(caplog):
    with caplog.at_level(logging.WARNING):
        env = maker_of("fmugym/CartPole-v0")({})
    assert "vector_entry_point" in caplog.text
    assert isinstance(env.unwrapped, fmugym.FMUEnv)
    env.close()


def config_for(name, **runners):
    return (
        PPOConfig()
        .environment(name)
        .env_runners(
            gym_env_vectorize_mode="vector_entry_point", num_envs_per_env_runner=4, **runners
        )
        .training(train_batch_size_per_learner=256, minibatch_size=128, num_epochs=1)
        .debugging(seed=3)
    )


@pytest.fixture(scope="module")
def ray_here():
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.mark.parametrize("env_id", ["fmugym/Pendulum-v0", "fmugym/House-v0"])
def test_ppo_trains(ray_here, env_id):
    register_task("trained", env_id)
    algorithm = config_for("trained", num_env_runners=0).build_algo()
    result = algorithm.train()
    assert result["env_runners"]["num_env_steps_sampled_lifetime"] >= 256
    assert isinstance(algorithm.env_runner.env.unwrapped, fmugym.FMUVectorEnv)
    algorithm.stop()


def test_a_remote_runner_has_as_many_threads_as_processors(ray_here):
    @ray.remote(num_cpus=2)
    def processors():
        return fmugym.training.rllib.assigned_processors()

    assert ray.get(processors.remote()) == 2
    assert fmugym.training.rllib.assigned_processors() == 1


def nodes_of(group):
    """The node of each runner; a lambda, because nodes cannot import this module."""
    return group.foreach_env_runner(
        lambda runner: ray.get_runtime_context().get_node_id(), local_env_runner=False
    )


class TestCluster:
    """Two nodes with a runner each; one of them dies."""

    @pytest.fixture
    def cluster(self):
        ray.shutdown()
        options = {"num_cpus": 1, "object_store_memory": MEMORY}
        head = {**options, "include_dashboard": False}
        cluster = Cluster(initialize_head=True, connect=True, head_node_args=head)
        options["resources"] = {"runner": 1}
        nodes = [cluster.add_node(**options) for _ in range(2)]
        cluster.wait_for_nodes()
        yield cluster, nodes, options
        ray.shutdown()
        cluster.shutdown()

    def test_the_training_goes_on_when_a_node_dies(self, cluster):
        cluster, nodes, options = cluster
        register_task("cart-pole", "fmugym/CartPole-v0")
        config = config_for(
            "cart-pole",
            num_env_runners=2,
            custom_resources_per_env_runner={"runner": 1},
            sample_timeout_s=20,
        ).fault_tolerance(
            restart_failed_env_runners=True,
            env_runner_health_probe_timeout_s=5,
            env_runner_restore_timeout_s=20,
        )
        algorithm = config.build_algo()
        group = algorithm.env_runner_group
        algorithm.train()
        before = nodes_of(group)
        assert len(set(before)) == 2

        cluster.remove_node(nodes[1], allow_graceful=False)
        steps = [trained_steps(algorithm) for _ in range(2)]
        assert steps[1] > steps[0]
        assert group.num_healthy_remote_workers() == 1

        cluster.add_node(**options)
        deadline = time.monotonic() + 100
        while group.num_healthy_remote_workers() < 2 and time.monotonic() < deadline:
            algorithm.train()
        after = nodes_of(group)
        assert len(set(after)) == 2
        assert len(set(after) & set(before)) == 1
        algorithm.stop()


def trained_steps(algorithm):
    return algorithm.train()["env_runners"]["num_env_steps_sampled_lifetime"]


def test_the_example_trains(tmp_path):
    ray.shutdown()
    command = [sys.executable, str(EXAMPLE), "--runners", "1", "--steps", "4000"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=170)
    assert done.returncode == 0, done.stderr
    mean = re.search(r"mean of 64 new episodes: ([\d.]+) of 500", done.stdout)
    assert float(mean[1]) > 9  # steps; no policy falls sooner on average
