"""Defects of other packages of this kind, each of which must not happen here.

The names of the classes are those of the packages in which the defects were found.
"""

import gc
import itertools
import logging
import os
import shutil
import zipfile

import gymnasium
import numpy as np
import pytest
from fmu_tools import MAJOR_VERSIONS, PlainEnv, probe_config

from fmugym import ConfigError, Uniform
from fmugym.archive.bundled import FMI_VERSIONS

every_version = pytest.mark.parametrize("version", MAJOR_VERSIONS)


class Limited(PlainEnv):
    """Ends when the integral of the input has reached 0.35."""

    def _is_done(self):
        return self.out["sum"] >= 0.35


class TestFMUGym:
    @every_version
    def test_actions_reach_the_inputs_in_the_order_of_the_config(self, make_env, version):
        """The XML has the inputs in the order c, a, b."""
        weights = {"a": 1.0, "b": 10.0, "c": 100.0}
        values = {"a": 0.5, "b": 0.25, "c": -0.125}
        for names in itertools.permutations(weights):
            env = make_env(version, model_input_names=list(names))
            env.reset()
            env.step([values[name] for name in names])
            assert env.out["mix"] == sum(weights[name] * values[name] for name in names)

    @every_version
    @pytest.mark.parametrize(
        "changes",
        [
            {"model_input_names": ["a", "bb"]},
            {"model_output_names": ["sum", "bb"]},
            {"monitor_names": ["bb"]},
            {"model_parameters": {"bb": 1.0}},
        ],
    )
    def test_unknown_names_are_not_dropped(self, make_env, version, changes):
        with pytest.raises(ConfigError, match="'bb'"):
            make_env(version, **changes)

    @every_version
    def test_the_seed_has_an_effect(self, make_env, version):
        env = make_env(version, model_parameters={"gain": Uniform(0.0, 1.0)})

        def gains(seed):
            env.reset(seed=seed)
            first = env.out["sum"], env.parameters["gain"]
            env.reset()
            return *first, env.parameters["gain"], env.read_variables("gain")["gain"]

        assert gains(1) == gains(1)
        assert gains(1) != gains(2)
        *_, one, two = gains(3)
        assert one == two

    @every_version
    def test_terminated_and_truncated_are_not_swapped(self, make_env, version):
        env = make_env(version, cls=Limited, max_episode_steps=4)
        env.reset()
        ends = [env.step(0.0)[2:4] for _ in range(4)]
        assert ends == [(False, False)] * 3 + [(False, True)]
        env.reset()
        ends = [env.step(1.0)[2:4] for _ in range(4)]
        assert ends[-1] == (True, True)
        short = make_env(version, cls=Limited)
        short.reset()
        ends = [short.step(1.0)[2:4] for _ in range(4)]
        assert ends == [(False, False)] * 3 + [(True, False)]

    @every_version
    def test_the_last_observation_is_of_this_episode(self, make_env, version):
        env = make_env(version, max_episode_steps=3)
        env.reset()
        observations = [env.step(1.0)[0][0] for _ in range(3)]
        assert observations == pytest.approx([0.1, 0.2, 0.3], abs=1e-7)
        assert env.reset()[0][0] == 0.0

    @every_version
    def test_termination_is_not_a_step_late(self, make_env, version):
        env = make_env(version, cls=Limited)
        env.reset()
        terminated = False
        while not terminated:
            observation, reward, terminated, *_ = env.step(1.0)
            assert terminated == (observation[0] >= np.float32(0.35))
            assert reward == (-100.0 if terminated else 1.0)
        assert env.step_count == 4

    @every_version
    def test_time_does_not_drift(self, make_env, version):
        """A sum of tenths is off by 2e-8 after 1e5 of them."""
        env = make_env(version, model_output_names="end", stop_time=10_000.0)
        env.reset()
        for _ in range(100_000 - 1):
            env.step(0.5)
        *_, truncated, _ = env.step(0.5)
        assert env.time == 10_000.0
        assert env.out["end"] == pytest.approx(10_000.0, rel=1e-15)
        assert truncated

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

    @every_version
    def test_no_temporary_folders_are_left(self, make_env, version, temp_root):
        env = make_env(version)
        assert len(list(temp_root.iterdir())) == 1
        for _ in range(3):
            env.reset()
        assert len(list(temp_root.iterdir())) == 1
        env.close()
        assert list(temp_root.iterdir()) == []

    @every_version
    def test_integer_and_boolean_outputs(self, make_env, version):
        names = ["steps", "on_out", "sum", "mode_out"]
        env = make_env(version, model_input_names=["a", "on"], model_output_names=names)
        env.reset()
        for count in range(1, 4):
            observation, *_ = env.step([0.5, 1.0])
            assert observation.tolist() == pytest.approx([count, 1.0, 0.05 * count, 1.0])
            assert observation in env.observation_space


class TestModelicaGym:
    @pytest.mark.parametrize("terminates", [False, True])
    def test_a_reward_of_zero_can_be_set(self, make_env, terminates):
        cls = type("Ends", (PlainEnv,), {"_is_done": lambda self: terminates})
        env = make_env(cls=cls, positive_reward=0, negative_reward=0)
        env.reset()
        assert env.step(0.0)[1] == 0.0

    def test_a_long_input_name_is_one_name(self, make_env):
        env = make_env(model_input_names="n_free", bounds={"n_free": (0, 1)})
        assert env.config.model_input_names == ("n_free",)

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

    def test_paths_do_not_depend_on_the_working_directory(self, tmp_path, probe, monkeypatch):
        """A relative path is relative to the file of the class, or of one that it derives from."""
        module = tmp_path / "project" / "tank_env.py"
        (module.parent / "models").mkdir(parents=True)
        shutil.copy(probe(2), module.parent / "models" / "Tank.fmu")
        module.write_text(
            "import fmugym\n"
            "class TankEnv(fmugym.FMI2CSEnv):\n"
            "    def __init__(self):\n"
            "        super().__init__('models/Tank.fmu', {'model_input_names': 'a',\n"
            "            'model_output_names': 'sum', 'time_step': 0.1})\n"
            "    def _is_done(self): return False\n"
        )
        monkeypatch.syspath_prepend(module.parent)
        import tank_env

        class Derived(tank_env.TankEnv):
            pass

        monkeypatch.chdir(tmp_path)
        for cls in (tank_env.TankEnv, Derived):
            env = cls()
            env.reset()
            env.close()

    @pytest.mark.parametrize(
        "hook", ["_is_done", "_is_truncated", "_reward_policy", "_get_observation", "_get_info"]
    )
    def test_hooks_that_return_nothing_are_noticed(self, make_env, hook):
        env = make_env(cls=type("Forgot", (PlainEnv,), {hook: lambda self: None}))
        with pytest.raises(ConfigError, match=hook):
            _one_step(env)

    def test_logger_levels_of_others_stay(self, probe):
        names = (None, "fmugym", "gymnasium", "fmpy", "fmugym.archive.fmu")
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

    @pytest.mark.parametrize("version", FMI_VERSIONS)
    @pytest.mark.parametrize("name", ["CartPole", "Pendulum", "ModelicaCartPole"])
    def test_the_observation_space_contains_what_is_observed(self, name, version):
        env = gymnasium.make(f"fmugym/{name}-v0", fmi_version=version)
        env.action_space.seed(0)
        for episode in range(20):
            observation, _ = env.reset(seed=episode)
            ended = False
            while not ended:
                assert observation in env.observation_space
                observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
                ended = terminated or truncated
            assert observation in env.observation_space
        env.close()


class TestEtaCtrl:
    @every_version
    @pytest.mark.parametrize("time_step", [0.001, 0.5, 1.7, 3600.0])
    def test_steps_need_not_be_whole_seconds(self, make_env, version, time_step):
        env = make_env(version, time_step=time_step, model_output_names=["step_size", "end"])
        env.reset()
        for _ in range(3):
            env.step(0.0)
        assert env.state == (time_step, pytest.approx(3 * time_step, rel=1e-15))


class TestStableRLS:
    @every_version
    def test_reset_takes_options_and_gives_info(self, make_env, version):
        env = make_env(version, episode_variables={"target": Uniform(1.0, 2.0)})
        observation, info = env.reset(seed=1, options={"model_parameters": {"gain": 4.0}})
        assert observation in env.observation_space
        assert info["drawn"]["gain"] == 4.0
        assert 1.0 <= info["drawn"]["target"] < 2.0
        env.step(1.0)
        assert env.out["sum"] == pytest.approx(0.4)
        _, info = env.reset()
        assert "gain" not in info["drawn"]
        env.step(1.0)
        assert env.out["sum"] == pytest.approx(0.1)


def _one_step(env):
    env.reset()
    env.step(0.0)


def test_garbage_of_many_envs_is_collected(probe, temp_root):
    """A user's loop that forgets to close."""
    for _ in range(5):
        PlainEnv(probe(2), probe_config()).reset()
    gc.collect()
    assert list(temp_root.iterdir()) == []
