"""From construction to the end: folders, files, output, copies, and the tutorial's own pattern."""

import copy
import gc
import logging
import os
import pickle
import zipfile

import gymnasium
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import MAJOR_VERSIONS, PlainEnv, edited_fmu, library_name, probe_config, probe_fmu
from gymnasium import spaces
from process_tools import run_python

import fmugym
from fmugym import FMI2CSEnv, FMULoadError, bundled_fmu

every_version = pytest.mark.parametrize("version", MAJOR_VERSIONS)


def run(code, *arguments):
    """Run code in another interpreter; returns what it wrote to stdout and stderr."""
    done = run_python("-W", "error", "-c", code, *arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


OPEN_AND_STEP = """
import sys, logging
from fmu_tools import PlainEnv, probe_config
parameters = {"log_status": 1}
env = PlainEnv(sys.argv[1], probe_config(model_parameters=parameters), logging.DEBUG)
for _ in range(4):
    env.reset()
    env.step(0.5)
"""


class TestTemporaryFolders:
    def test_gone_after_close(self, make_env, temp_root):
        env = make_env()
        env.reset()
        env.step(0.0)
        assert len(list(temp_root.iterdir())) == 1
        env.close()
        assert list(temp_root.iterdir()) == []
        env.close()

    @in_turn(
        {
            "ending": ["", "del env", "env.close()", "raise SystemExit", "globals().clear()"],
            "version": MAJOR_VERSIONS,
        }
    )
    def test_gone_at_the_end_of_the_interpreter(self, probe, version, temp_root, ending):
        run(OPEN_AND_STEP + ending, probe(version))
        assert list(temp_root.iterdir()) == []

    @in_turn({"stage": ["token", "library", "hook"], "version": MAJOR_VERSIONS})
    def test_gone_after_a_failed_construction(
        self, probe, tmp_path, version, temp_root, same_working_directory, stage
    ):
        path, cls, error = probe(version), PlainEnv, FMULoadError
        if stage == "token":
            path = edited_fmu(path, tmp_path, {"{probe-": "{other-"})
        elif stage == "library":
            path = edited_fmu(path, tmp_path, add={library_name(version): bytes(100)})
        else:
            error = ZeroDivisionError
            cls = type("Broken", (PlainEnv,), {"_get_action_space": lambda self: 1 / 0})
        with pytest.raises(error):
            cls(path, probe_config())
        assert list(temp_root.iterdir()) == []

    def test_a_subclass_that_fails_after_the_base_class(self, probe, temp_root):
        class Broken(PlainEnv):
            def __init__(self, *args):
                super().__init__(*args)
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            Broken(probe(2), probe_config())
        gc.collect()
        assert list(temp_root.iterdir()) == []


class TestManyLives:
    def test_many_at_once(self, probe, temp_root):
        envs = [PlainEnv(probe(2), probe_config()) for _ in range(30)]
        for env in envs:
            env.reset()
        for env in envs[::2] + envs[1::2]:
            env.step(1.0)
            assert env.out["sum"] == 0.1
            env.close()
        assert list(temp_root.iterdir()) == []

    def test_resets_take_no_memory(self, make_env):
        """Each kind of reset: a saved state, and new parameters."""
        env = make_env(2, model_output_names=["live", "instances", "illegal"])
        for index in range(300):
            env.reset(options={"model_parameters": {"gain": float(index // 3)}})
            env.step(0.0)
        assert env.out["live"] <= 1
        assert (env.out["instances"], env.out["illegal"]) == (1, 0)


class TestCalm:
    """What does not happen."""

    @every_version
    def test_a_reset_neither_unzips_nor_loads_nor_instantiates(
        self, make_env, version, monkeypatch
    ):
        env = make_env(version, model_output_names="instances")
        env.reset()

        def refuse(*_, **__):
            raise AssertionError("the FMU was opened again")

        monkeypatch.setattr(zipfile, "ZipFile", refuse)
        folder = env.fmu.extract()
        for gain in (1.0, 1.0, 1.0, 2.0):
            env.reset(options={"model_parameters": {"gain": gain}})
            env.step(0.0)
        assert env.state == (1.0,)
        assert env.health["replacements"] == 0
        assert env.fmu.extract() == folder

    def test_the_constructor_does_not_reset(self, make_env):
        """There a hook would run before the subclass has set its own attributes."""

        class Late(PlainEnv):
            def __init__(self, *args, **keywords):
                super().__init__(*args, **keywords)
                self.limit = 5.0

            def _get_observation(self):
                return np.clip(np.float32(self.state), -self.limit, self.limit)

        env = make_env(cls=Late)
        assert env.action_space is not None
        assert env.reset()[0] in env.observation_space

    def test_logger_levels_of_others_stay(self, probe):
        names = (None, "fmugym", "gymnasium", "fmpy", "fmugym.fmi.fmu")
        before = [logging.getLogger(name).level for name in names]
        env = PlainEnv(probe(2), probe_config(), logging.DEBUG)
        assert env.logger.level == logging.DEBUG
        env.reset()
        env.close()
        assert [logging.getLogger(name).level for name in names] == before
        assert env.logger.handlers == []

    def test_no_file_is_written(self, make_env, tmp_path, temp_root, monkeypatch):
        monkeypatch.chdir(tmp_path)
        before = sorted(os.listdir(tmp_path))
        env = make_env()
        env.reset()
        env.step(0.5)
        env.close()
        assert sorted(os.listdir(tmp_path)) == before
        assert list(temp_root.iterdir()) == []


@every_version
def test_nothing_on_stdout_and_messages_once(probe, version):
    out, err = run(OPEN_AND_STEP + "env.close()", probe(version))
    assert out == ""
    assert err.count("step 1 of probe is 100%") == 4


class TestCopies:
    @pytest.fixture(
        params=[copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))],
        ids=["copy", "deepcopy", "pickle"],
    )
    def clone(self, request, opened):
        return lambda env: opened(request.param(env))

    def test_a_copy_is_an_environment_of_its_own(self, make_env, clone):
        env = make_env(model_parameters={"gain": fmugym.Uniform(0.0, 1.0)}, max_episode_steps=3)
        env.reset(seed=1)
        env.step(1.0)
        twin = clone(env)
        first, info = twin.reset(seed=7)
        twin.step(1.0)
        assert env.step_count == 1
        again, same = env.reset(seed=7)
        env.step(1.0)
        assert (info, first.tolist()) == (same, again.tolist())
        assert twin.state == env.state
        env.close()
        twin.step(1.0)

    def test_of_a_subclass_with_arguments_of_its_own(self, clone):
        env = fmugym.envs.CartPoleEnv(True, fmi_version="3.0", model_parameters={"m_pole": 0.2})
        twin = clone(env)
        env.reset(seed=3)
        twin.reset(seed=3)
        for action in (0, 1, 1, 0):
            assert env.step(action)[1] == twin.step(action)[1] == 0.0
        assert twin.state == env.state
        assert twin.parameters["m_pole"] == 0.2
        assert twin.fmu.description.fmi_version == "3.0"
        env.close()

    def test_of_a_closed_environment(self, make_env, clone):
        env = make_env()
        env.close()
        twin = clone(env)
        twin.reset()
        twin.step(0.0)

    def test_in_a_child_process(self, probe, tmp_path):
        env = PlainEnv(probe(2), probe_config(model_parameters={"gain": 3.0}))
        file = tmp_path / "env.pickle"
        file.write_bytes(pickle.dumps(env))
        env.close()
        code = (
            "import pathlib, pickle, sys\n"
            "env = pickle.loads(pathlib.Path(sys.argv[1]).read_bytes())\n"
            "env.reset(); env.step(1.0); print(round(env.out['sum'], 12)); env.close()"
        )
        out, _ = run(code, file)
        assert out == "0.3\n"


logger = logging.getLogger("tutorial")
NINETY_DEGREES_IN_RAD = np.pi / 2
TWELVE_DEGREES_IN_RAD = np.pi / 15


class TutorialCartPoleEnv(FMI2CSEnv):
    """A subclass as ModelicaGym's tutorial has it, in our own words."""

    metadata = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(
        self, m_cart, m_pole, theta_0, theta_dot_0, time_step, good, bad, force, log_level
    ):
        logger.setLevel(log_level)
        self.force = force
        self.theta_threshold = TWELVE_DEGREES_IN_RAD
        self.x_threshold = 2.4
        self.viewer = None
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "theta", "theta_dot"],
            "model_parameters": {
                "m_cart": m_cart,
                "m_pole": m_pole,
                "theta_0": theta_0,
                "theta_dot_0": theta_dot_0,
            },
            "time_step": time_step,
            "positive_reward": good,
            "negative_reward": bad,
        }
        super().__init__(str(bundled_fmu("CartPole")), config, log_level)

    def _is_done(self):
        x, x_dot, theta, theta_dot = self.state
        logger.debug("x: %s, x_dot: %s, theta: %s, theta_dot: %s", x, x_dot, theta, theta_dot)
        lean = abs(theta - NINETY_DEGREES_IN_RAD)
        if abs(x) > self.x_threshold or lean > self.theta_threshold:
            done = True
        else:
            done = False
        return done

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_observation_space(self):
        high = np.array([self.x_threshold, np.inf, self.theta_threshold, np.inf])
        return spaces.Box(-high, high)

    def step(self, action):
        action = self.force if action > 0 else -self.force
        return super().step(action)

    def render(self, mode="human", close=False):
        if close:
            if self.viewer is not None:
                self.viewer = None
            return True
        self.viewer = [mode, *self.state]
        return self.viewer

    def close(self):
        return self.render(close=True)


@pytest.mark.filterwarnings("ignore:.*precision lowered by casting to float32")
class TestTutorial:
    def make(self, **changes):
        arguments = {
            "m_cart": 10.0,
            "m_pole": 1.0,
            "theta_0": np.radians(85),
            "theta_dot_0": 0.0,
            "time_step": 0.05,
            "good": 1,
            "bad": -100,
            "force": 12.0,
            "log_level": logging.WARNING,
        }
        return TutorialCartPoleEnv(**(arguments | changes))

    def test_an_episode(self):
        """The plant is that of the registered environment: so must be the trajectory."""
        env, ours = self.make(), gymnasium.make("fmugym/ModelicaCartPole-v0")
        observation, info = env.reset()
        expected, _ = ours.reset()
        np.testing.assert_array_equal(observation, expected)
        assert info == {"drawn": {}}
        terminated = False
        while not terminated:
            action = int(env.state[2] < NINETY_DEGREES_IN_RAD)
            observation, reward, terminated, truncated, _ = env.step(action)
            expected, expected_reward, *ends, _ = ours.step(action)
            np.testing.assert_array_equal(observation, expected)
            assert (reward, [terminated, truncated]) == (expected_reward, ends)
        assert reward == -100
        assert env.step_count > 10
        assert env.render()[1:] == list(env.state)
        assert env.close() is True
        ours.close()

    def test_folders_go_though_close_does_not_call_the_base_class(self, temp_root):
        env = self.make()
        env.reset()
        env.close()
        env.close()
        del env
        gc.collect()
        assert list(temp_root.iterdir()) == []


def test_a_library_beside_the_fmu_is_found(tmp_path):
    """FMUs bring data in their resources; the folder is there while the environment lives."""
    path = probe_fmu(tmp_path, 2, add={"resources/table.csv": "1,2"})
    env = PlainEnv(path, probe_config())
    folder = env.fmu.extract()
    assert (folder / "resources" / "table.csv").read_text() == "1,2"
    env.close()
    assert not folder.exists()


@pytest.mark.parametrize(
    "made",
    [
        "class Mine(fmugym.FMI2CSEnv):\n    def _is_done(self): return False\n",
        "Mine = type('Mine', (fmugym.FMI2CSEnv,), {'_is_done': lambda self: False})\n",
    ],
)
def test_relative_paths_of_a_class_without_a_file(made, tmp_path, monkeypatch):
    """As in a notebook, where classes have no file: the working directory counts."""
    probe_fmu(tmp_path, 2)
    monkeypatch.chdir(tmp_path)
    out, _ = run(
        "import fmugym\n"
        + made
        + "config = {'model_input_names': 'a', 'model_output_names': 'sum', 'time_step': 0.1}\n"
        "env = Mine('Probe.fmu', config)\n"
        "env.reset(); print(env.state); env.close()"
    )
    assert out == "(0.0,)\n"


def test_own_attributes_do_not_steer_the_pool():
    """They may have the names of arguments of the constructor."""

    class Own(FMI2CSEnv):
        def __init__(self):
            config = {
                "model_input_names": "f",
                "model_output_names": "x",
                "time_step": 0.02,
                "terminated": False,
            }
            super().__init__(bundled_fmu("CartPole"), config)
            self.backend, self.isolation = "my own", "mine"

    envs = fmugym.FMUVectorEnv(Own, 2)
    assert envs.reset(seed=0)[0].shape == (2, 1)
    envs.close()
