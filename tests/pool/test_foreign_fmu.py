"""An FMU of another exporter: ``pythonfmu`` makes it of a class that is also stepped directly."""

from pathlib import Path

import foreign_tank
import numpy as np
import pytest
from pythonfmu.builder import FmuBuilder

import fmugym
from fmugym import errors
from fmugym.testing import check_fmu_env

OUTPUTS = ("level", "overflowing", "switches")


class TankEnv(fmugym.FMI2CSEnv):
    """Keep the level of a tank at one metre."""

    def __init__(self, fmu_path, **changes):
        config = {
            "model_input_names": ["inflow", "valve_open", "pump_stage"],
            "model_output_names": OUTPUTS,
            "model_parameters": {"area": fmugym.Uniform(1.0, 3.0), "leaks": True},
            "time_step": 0.5,
            "bounds": {"inflow": (0.0, 0.5), "pump_stage": (0, 3)},
            "max_episode_steps": 40,
        }
        super().__init__(fmu_path, config | changes)

    def _is_done(self):
        return self.out["level"] < 0.2

    def _reward_policy(self):
        return -abs(self.out["level"] - 1.0)


@pytest.fixture(scope="module")
def tank_fmu(tmp_path_factory):
    path = FmuBuilder.build_FMU(foreign_tank.__file__, dest=tmp_path_factory.mktemp("tank"))
    if not fmugym.FMU(path).runs_here:
        pytest.skip("pythonfmu has no binary for this platform")
    return Path(path)


@pytest.fixture
def env(tank_fmu):
    env = TankEnv(tank_fmu)
    yield env
    env.close()


def test_the_need_of_a_tool_is_told_once(tank_fmu, caplog, monkeypatch):
    """A search opens an FMU many times."""
    monkeypatch.setattr(errors, "_warned", set())
    for _ in range(2):
        TankEnv(tank_fmu).close()
    assert caplog.text.count("Tank.fmu needs the tool that exported it to run") == 1


def test_what_is_invalid_in_it_does_not_stop(env):
    """Without a variability, Integers and Booleans are continuous, which the standard forbids."""
    assert any("variability" in finding for finding in env.fmu.description.findings)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_contract_of_the_package(env, seed):
    check_fmu_env(env, seed=seed, num_steps=60)


def test_many_instances_and_lives(tank_fmu):
    """The exporter embeds Python itself: instances come and go beside this interpreter."""
    envs = [TankEnv(tank_fmu, model_parameters={"area": 1.0 + i}) for i in range(4)]
    for env in envs:
        env.reset()
    envs.pop(1).close()
    envs.append(TankEnv(tank_fmu, model_parameters={"area": 8.0}))
    envs[-1].reset()
    for env in envs:
        env.step(np.array([0.4, 0.0, 0.0]))
        expected = 1.0 + 0.5 * 0.4 / env.parameters["area"]
        assert env.out["level"] == pytest.approx(expected, rel=1e-14)
        env.close()
