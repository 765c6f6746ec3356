"""The single environment: its contract, hooks, episodes and faults."""

import logging
import math

import fmpy
import gymnasium as gym
import numpy as np
import pytest
from combinations import in_turn
from contract_cases import ActionsInParts
from fmu_tools import probe_fmu
from vector_tools import ABSURD, IDS, Cart, Reaching

import fmugym
from fmugym import Choice, ConfigError, Normal, Uniform
from fmugym.environment.env_checker import check_fmu_env
from fmugym.fmi.bundled import FMI_VERSIONS


class Swing(fmugym.FMUEnv):
    """A pendulum, torque in, angle and velocity out; the config may be changed at will."""

    def __init__(self, fmi_version="2.0", **config):
        defaults = {
            "model_input_names": ["tau"],
            "model_output_names": ["q", "q_dot"],
            "model_parameters": {"q_0": 1.0},
            "time_step": 0.02,
            "bounds": {"tau": (-1.0, 1.0)},
        }
        path = fmugym.bundled_fmu("Pendulum", fmi_version)
        super().__init__(path, defaults | config)

    def _is_done(self):
        return self.out["q"] > 2.0


@in_turn({"env_id": IDS, "fmi_version": FMI_VERSIONS})
def test_contract(env_id, fmi_version):
    env = gym.make(env_id, fmi_version=fmi_version)
    check_fmu_env(env)
    env.close()


@pytest.mark.parametrize("fmi_version", FMI_VERSIONS)
def test_time_is_exact_after_100_000_steps(fmi_version):
    env = Swing(fmi_version, time_step=0.1, start_time=0.0)
    env.reset()
    for _ in range(100_000):
        env.step(0.0)
    assert env.time == 100_000 * 0.1
    assert env.read_variables("time")["time"] == pytest.approx(10_000, rel=1e-12)
    env.close()


def test_start_time_and_stop_time():
    env = Swing(start_time=5.0, stop_time=5.1)
    env.reset()
    assert env.time == 5.0
    ends = [env.step(0.0)[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]
    env.close()


def test_no_time_for_a_step():
    with pytest.raises(ConfigError, match="leaves no time for a step"):
        Swing(stop_time=0.01)


def test_inputs_after_a_reset_are_their_start_values():
    env = Swing(model_parameters={"tau": 0.01})
    env.reset()
    assert env.inputs == (0.01,)
    assert env.read_variables("tau") == {"tau": 0.01}
    env.close()


def test_warm_up_runs_before_the_first_observation():
    warm, cold = Swing(warm_up=0.1), Swing()
    first, _ = warm.reset()
    cold.reset()
    for _ in range(5):
        observation, *_ = cold.step(0.0)
    assert first.tolist() == observation.tolist()
    assert (warm.time, warm.step_count) == (0.1, 0)
    for _ in range(3):  # also from the saved state
        assert warm.reset()[0].tolist() == first.tolist()
    warm.close()
    cold.close()


def test_terminated_and_truncated_may_both_be_true():
    class Both(Swing):
        def _is_done(self):
            return True

        def _is_truncated(self):
            return True

    env = Both(positive_reward=2, negative_reward=-3)
    env.reset()
    _, reward, terminated, truncated, _ = env.step(0.0)
    assert (reward, terminated, truncated) == (-3.0, True, True)
    env.close()


@pytest.mark.parametrize(("positive", "negative"), [(1, -100), (0, 0), (0.5, -1.5)])
def test_default_reward(positive, negative):
    env = Swing(positive_reward=positive, negative_reward=negative)
    env.reset(options={"model_parameters": {"q_0": 1.5}})
    rewards = []
    terminated = False
    while not terminated:
        _, reward, terminated, _, _ = env.step(1.0)
        rewards.append(reward)
    assert rewards == [positive] * (len(rewards) - 1) + [negative]
    env.close()


def test_what_hooks_read():
    env = Swing(monitor_names=["theta", "theta_ddot"], model_parameters={"q_0": 1.0, "m": 0.05})
    env.reset()
    start = env.state
    assert start == (1.0, 0.0)
    assert env.action.tolist() == env.previous_action.tolist() == [0.0]
    assert env.previous_state == start
    assert (env.time, env.step_count, env.done) == (0.0, 0, False)
    env.step(0.01)
    env.step(0.02)
    assert (env.action, env.previous_action) == (0.02, 0.01)
    assert env.inputs == (0.02,)
    assert (env.time, env.step_count) == (0.04, 2)
    assert env.out["q"] == env.state[0]
    assert env.out["theta"] == pytest.approx(env.state[0] - math.pi)
    assert dict(env.out).keys() == {"q", "q_dot", "theta", "theta_ddot"}
    assert len(env.state) == 2
    assert env.parameters["m"] == 0.05
    assert env.read_variables("m", "tau") == {"m": 0.05, "tau": 0.02}
    env.close()


def test_episode_variables():
    class Tracking(Swing):
        def _update(self):
            self.variables["integral"] += abs(self.out["q"] - self.variables["target"])

        def _is_done(self):
            return False

        def _reward_policy(self):
            return -self.variables["integral"]

    env = Tracking(episode_variables={"target": Uniform(-1, 1), "integral": 0.0})
    _, info = env.reset(seed=1)
    target = env.variables["target"]
    assert info["drawn"] == {"target": target}
    assert -1 <= target <= 1
    total = 0.0
    for _ in range(3):
        _, reward, *_ = env.step(0.0)
        total += abs(env.out["q"] - target)
    assert reward == -total
    env.reset()
    assert env.variables["integral"] == 0.0
    assert env.variables["target"] != target
    env.close()


def test_drawn_parameters_are_set_and_told():
    random = {"q_0": Uniform(0.5, 1.5), "m": Choice([0.05, 0.07]), "b": Normal(4e-4, 1e-4, low=0)}
    env = Swing(model_parameters=random)
    seen = []
    for seed in (1, 2, 1):
        observation, info = env.reset(seed=seed)
        assert info["drawn"] == dict(env.parameters) == env.read_variables("q_0", "m", "b")
        assert observation[0] == np.float32(info["drawn"]["q_0"])
        seen.append(info["drawn"])
    assert seen[0] == seen[2] != seen[1]
    assert env.reset()[1]["drawn"] != seen[0]  # no seed: the stream goes on
    env.close()


def test_parameters_of_one_episode():
    env = Swing()
    _, info = env.reset(options={"model_parameters": {"q_0": 0.5, "m": 0.1}})
    assert info["drawn"] == {"q_0": 0.5, "m": 0.1}
    assert (env.state[0], env.read_variables("m")["m"]) == (0.5, 0.1)
    _, info = env.reset()
    assert info["drawn"] == {}
    assert (env.state[0], env.read_variables("m")["m"]) == (1.0, 0.06)
    env.close()


def test_a_fault_truncates_with_the_last_good_observation():
    env = Cart(fault_reward=-7.0)
    env.reset()
    before, *_ = env.step(1.0)
    observation, reward, terminated, truncated, info = env.step(ABSURD)
    assert observation.tolist() == before.tolist()
    assert (reward, terminated, truncated) == (-7.0, False, True)
    assert "returned Discard" in info["fault"]
    assert "t = 0.02 s" in info["fault"]
    assert np.isfinite(env.reset()[0]).all()  # mended
    assert np.isfinite(env.step(1.0)[0]).all()
    env.close()


def test_faults_are_logged(caplog):
    env = Cart()
    env.reset()
    with caplog.at_level(logging.WARNING, "fmugym.Cart"):
        env.step(ABSURD)
    assert "returned Discard" in caplog.text
    env.close()


def test_goal_task():
    env = Reaching()
    env.reset(seed=1)
    _, reward, *_ = env.step(env.action_space.sample())
    assert reward == -(abs(env.out["q"] - env.variables["goal"]) > 0.5)
    goals = np.array([[0.0], [1.0]]), np.array([[1.0], [1.0]])
    assert env.compute_reward(*goals, {}).tolist() == [-1.0, 0.0]
    check_fmu_env(env)
    env.close()
    assert hasattr(env, "compute_reward")
    assert not hasattr(Swing(), "compute_reward")  # which is how others tell a goal task


def test_render_fps_follows_the_time_step():
    assert Swing(time_step=0.04).metadata["render_fps"] == 25
    assert Swing(time_step=3.0).metadata["render_fps"] == 1
    assert Swing.metadata == {"render_modes": []}


def test_default_time_step_is_the_fmus():
    env = Swing(time_step=None)
    env.reset()
    env.step(0.0)
    assert env.time == env.fmu.description.step_size == 0.01
    env.close()


def test_the_class_may_be_subclassed_for_a_relative_path(tmp_path, monkeypatch):
    """A relative path is looked for beside the file of the class, not in the working directory."""
    import shutil
    import sys

    package = tmp_path / "somewhere"
    package.mkdir()
    shutil.copy(fmugym.bundled_fmu("Pendulum"), package / "My.fmu")
    (package / "my_relative_env.py").write_text(
        "import fmugym\n"
        "class Mine(fmugym.FMI2CSEnv):\n"
        "    def __init__(self, path='My.fmu'):\n"
        "        super().__init__(path, {'model_input_names': 'tau', 'model_output_names': 'q'})\n"
        "    def _is_done(self):\n"
        "        return False\n"
    )
    monkeypatch.syspath_prepend(str(package))
    monkeypatch.chdir(tmp_path)
    from my_relative_env import Mine

    for cls in (Mine, type("Derived", (Mine,), {})):
        env = cls()
        env.reset()
        assert np.isfinite(env.step(0.0)[0]).all()
        env.close()
    with pytest.raises(fmugym.FMULoadError, match="somewhere"):
        Mine("Other.fmu")
    sys.modules.pop("my_relative_env")


class TestTolerance:
    """The solver's tolerance; the probe tells which one it was given, -1 for none."""

    EXPERIMENT = '<DefaultExperiment tolerance="0.0025"/><TypeDefinitions>'

    @pytest.fixture(params=[2, 3])
    def path(self, tmp_path, request):
        return probe_fmu(tmp_path, request.param, {"<TypeDefinitions>": self.EXPERIMENT})

    @pytest.fixture(params=["none", "process"])
    def seen(self, make_env, path, request):
        """Make what the FMU sees with a config."""

        def make(**config):
            env = make_env(path=path, isolation=request.param, **config)
            env.reset()
            return env.read_variables("tolerance")["tolerance"]

        return make

    def test_is_that_of_the_default_experiment_as_in_fmpy(self, seen, path):
        result = fmpy.simulate_fmu(
            str(path), fmi_type="CoSimulation", stop_time=0.1, validate=False, output=["tolerance"]
        )
        assert seen() == result["tolerance"][0] == 0.0025

    def test_is_that_of_the_config(self, seen, path):
        result = fmpy.simulate_fmu(
            str(path),
            fmi_type="CoSimulation",
            stop_time=0.1,
            validate=False,
            relative_tolerance=1e-6,
            output=["tolerance"],
        )
        assert seen(tolerance=1e-6) == result["tolerance"][0] == 1e-6

    @pytest.mark.parametrize("version", [2, 3])
    def test_is_not_given_if_there_is_none(self, make_env, version):
        env = make_env(version)
        env.reset()
        assert env.read_variables("tolerance")["tolerance"] == -1.0


def test_before_the_first_action_in_parts_are_zeros():
    with ActionsInParts() as env:
        env.reset(seed=1)
        assert env.step(env.action_space.sample())[1] == 0.0
