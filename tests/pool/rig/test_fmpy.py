"""``backend="fmpy"``: what FMPy's own classes make of an FMU, and what they are not used for."""

import logging
import threading

import clocks_tools
import exchange_tools
import fmu_tools
import gymnasium as gym
import numpy as np
import pytest
import values_tools
from fmu_tools import MAJOR_VERSIONS, PlainEnv, edited_fmu, grouped
from plants import PLANTS

import fmugym
from fmugym import ConfigError, FMULoadError, FMUSystem, bundled_fmu
from fmugym.fmi.bundled import BUNDLED_FMUS
from fmugym.pool import PoolSpec
from fmugym.pool.opening import PoolOptions, open_pool

PENDULUM = bundled_fmu("Pendulum")
all_versions = pytest.mark.parametrize("version", MAJOR_VERSIONS)
bundled = pytest.mark.parametrize(("model", "version"), BUNDLED_FMUS)


def config_of(model, **changes):
    """Draws a start value; takes the input within its strength."""
    name, outputs, start, strength = PLANTS[model]
    values = fmugym.Uniform(290, 295) if model == "House" else fmugym.Uniform(1.4, 1.7)
    config = {
        "model_input_names": name,
        "model_output_names": outputs,
        "model_parameters": {start: values},
        "bounds": {name: (-strength, strength)},
        "time_step": 0.05,
        "substeps": 2,
        "warm_up": 0.1,
    }
    return grouped(config | changes)


def play(env, steps=15):
    """Three episodes: every state and status."""
    env.action_space.seed(1)
    rows = []
    for seed in (5, None, None):
        env.reset(seed=seed)
        rows.append(states_of(env))
        for _ in range(steps):
            env.step(env.action_space.sample())
            rows.append(states_of(env))
    env.close()
    return np.array(rows)


def states_of(env):
    return np.array(env.get_attr("state") if hasattr(env, "num_envs") else env.state)


class TestEqualToTheEngine:
    @bundled
    def test_single(self, model, version):
        path = bundled_fmu(model, version)
        ours, theirs = (
            play(PlainEnv(path, config_of(model), backend=way)) for way in ("native", "fmpy")
        )
        assert np.array_equal(ours, theirs)

    @all_versions
    def test_types_and_times(self, probe, version):
        """Integers, Booleans, enumerations, start time, stop time and tolerance."""
        path = probe(version)
        config = {
            "model_input_names": ["mode", "on", "n", "a"],
            "model_output_names": ["mode_out", "on_out", "n_out", "mix", "end"],
            "monitor_names": ["stop", "tolerance"],
            "bounds": {"mode": (1, 3), "n": (-5, 5), "a": (-1, 1)},
            "time_step": 0.1,
            "start_time": 2.5,
            "stop_time": 50.0,
            "tolerance": 1e-5,
        }

        def rows(way):
            env = PlainEnv(path, config, backend=way)
            env.reset()
            found = [list(env.out.values())]
            for action in ([2, 1, -3, 0.5], [3, 0, 4, -0.5]):
                env.step(action)
                found.append(list(env.out.values()))
            env.close()
            return found

        assert np.array_equal(rows("native"), rows("fmpy"))

    def test_start_times_of_episodes(self):
        path, given = bundled_fmu("House", "3.0"), fmugym.Uniform(0.0, 100.0)
        config = config_of("House", start_time=given)
        ours, theirs = (play(PlainEnv(path, config, backend=way)) for way in ("native", "fmpy"))
        assert np.array_equal(ours, theirs)


class TestEpisodes:
    @all_versions
    def test_begin_anew_where_the_reset_of_an_fmu_does_not(self, probe, version):
        config = fmu_tools.probe_config(model_parameters={"leaky": True}, bounds={"a": (0, 1)})
        env = PlainEnv(probe(version), config, backend="fmpy")
        for _ in range(2):
            env.reset()
            assert env.out["sum"] == 0.0
            env.step([1.0])
            assert env.out["sum"] == 0.1
        env.close()

    def test_leave_nothing(self, temp_root):
        envs = gym.make_vec("fmugym/CartPole-v0", num_envs=3, backend="fmpy")
        before = set(threading.enumerate())
        envs.reset(seed=1)
        envs.step(np.zeros(3, int))
        assert set(threading.enumerate()) <= before
        envs.close()
        assert list(temp_root.iterdir()) == []

    @all_versions
    def test_go_on_after_a_fault(self, probe, version, caplog):
        parameters = {"fault": 3, "fault_step": 2, "log_status": 1}
        config = fmu_tools.probe_config(model_parameters=parameters, bounds={"a": (0, 1)})
        env = PlainEnv(probe(version), config, backend="fmpy")
        for _ in range(2):
            env.reset()
            assert not env.step([1.0])[3]
            _, _, _, truncated, info = env.step([1.0])
            assert truncated
            assert "t = 0.1 s returned Error; the FMU said: step 1 of" in info["fault"]
        assert env.health["errors"] == 2
        env.close()
        assert caplog.text.count("[probe] step 1 of probe is 100%") == 2


class TestRefusals:
    @pytest.mark.parametrize(
        ("changes", "name"),
        [
            ({"fault_retries": 1}, "fault_retries"),
            ({"samplings": {"theta": "mean"}}, "samplings"),
            ({"reset_method": "reset"}, "reset_method"),
            ({"isolation": "process"}, "isolation"),
        ],
    )
    def test_of_configs(self, temp_root, changes, name):
        with pytest.raises(ConfigError, match=rf"Pendulum.fmu \(.*{name}.*\) needs the C ext"):
            PlainEnv(bundled_fmu("Pendulum"), config_of("Pendulum", **changes), backend="fmpy")
        assert list(temp_root.iterdir()) == []

    @pytest.mark.parametrize(
        ("make", "names", "reason"),
        [
            (lambda path: exchange_tools.exchange_fmu(path, "ball"), ("e", "h"), "model exchange"),
            (clocks_tools.clocks_fmu, ("plain", "x"), "clocks and event mode"),
            (lambda path: values_tools.state_space_fmu(path), ("u", "y"), "arrays"),
        ],
    )
    def test_of_fmus(self, tmp_path, make, names, reason):
        path = make(tmp_path / "Other.fmu")
        config = {
            "model_input_names": names[0],
            "model_output_names": names[1],
            "bounds": {names[0]: (-1.0, 1.0)},
            "time_step": 0.1,
        }
        with pytest.raises(ConfigError, match=rf"Other.fmu \({reason}.*\) needs the C ext"):
            PlainEnv(path, config, backend="fmpy")

    def test_of_systems(self):
        both = FMUSystem({"one": PENDULUM, "other": PENDULUM}, []).as_fmu()
        with pytest.raises(ConfigError, match="a system"):
            open_pool(
                both, PoolSpec((), (), 0.1), 1, logging.getLogger("test"), PoolOptions("fmpy")
            )

    def test_of_snapshots(self):
        env = gym.make("fmugym/Pendulum-v0", backend="fmpy").unwrapped
        env.reset(seed=1)
        with pytest.raises(fmugym.SimulationError, match="the C extension"):
            env.save_state()
        env.close()

    def test_of_an_fmu_that_lacks_a_function(self, probe, tmp_path):
        files = fmu_tools.read_fmu(probe(1))
        renamed = {fmu_tools.library_name(1, "Other"): files[fmu_tools.library_name(1)]}
        edits = {'modelIdentifier="Probe"': 'modelIdentifier="Other"'}
        path = edited_fmu(probe(1), tmp_path, edits, add=renamed)
        with pytest.raises(FMULoadError, match=r"cannot be loaded: .*Other_fmi"):
            PlainEnv(path, fmu_tools.probe_config(), backend="fmpy")
