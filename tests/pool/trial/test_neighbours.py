"""FMUs whose instances disturb each other only while they are initialized."""

import functools
import logging
import sys

import numpy as np
import pytest
from demanding_tools import STEP, DemandingEnv, expected_outputs, make_fmu

import fmugym
from fmugym.pool.native_pool import NativePool
from fmugym.pool.pool_spec import PoolSpec
from fmugym.pool.trial.trial import examine
from fmugym.pool.trial.verdict import Neighbours, known_verdict

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

NUM_ENVS = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("demanding")


@pytest.fixture(autouse=True)
def no_licences(trials, monkeypatch):
    """Those of other tests may be in the process that starts workers."""
    monkeypatch.setenv("LICENCES", "")


def make_pool(path, one_initialization):
    fmu = fmugym.FMU(path)
    spec = PoolSpec(
        (fmu.variable("u"),),
        (fmu.variable("y"),),
        STEP,
        one_initialization=one_initialization,
    )
    return NativePool(fmu, spec, NUM_ENVS, logging.getLogger("test"), threads=2)


def bad_statuses(pool, resets):
    """How many of several initializations at the same time fail."""
    count = 0
    for _ in range(resets):
        count += np.count_nonzero(pool.reset((), np.zeros((0, NUM_ENVS)))[1] > 1)
    return count


class TestOneInitializationAtATime:
    def test_is_what_the_pool_does(self, folder):
        path = make_fmu(folder, "strtok")
        at_once, in_turn = make_pool(path, False), make_pool(path, True)
        assert bad_statuses(at_once, 10) > 0
        assert bad_statuses(in_turn, 10) == 0
        at_once.close()
        in_turn.close()

    @pytest.mark.parametrize("options", [{}, {"threads": 2}, {"isolation": "process"}])
    def test_serves_a_vector_environment(self, folder, caplog, options):
        caplog.set_level(logging.INFO, "fmugym")
        path = make_fmu(folder, "strtok")
        make = functools.partial(DemandingEnv, path, gain=fmugym.Uniform(1.0, 2.0), log_level=20)
        envs = fmugym.FMUVectorEnv(make, NUM_ENVS, autoreset_mode="Disabled", **options)
        for seed in range(4):
            _, infos = envs.reset(seed=seed)
            gains, action = infos["drawn"]["gain"], np.full((NUM_ENVS, 1), 0.5, np.float32)
            for _ in range(3):
                envs.step(action)
            for gain, state in zip(gains, envs.get_attr("state"), strict=True):
                assert state[0] == expected_outputs(gain, [0.5] * 3)[-1]
        envs.close()
        assert "its instances are initialized one at a time" in caplog.text
        assert "stepped by one thread" not in caplog.text

    def test_is_told_by_info(self, folder, ran):
        path = make_fmu(folder, "strtok")
        fmugym.FMUVectorEnv(lambda: DemandingEnv(path), 2).close()
        assert known_verdict(fmugym.FMU(path)).neighbours is Neighbours.ONE_INITIALIZATION
        assert "its instances are initialized one at a time" in ran("info", path)


class TestGrades:
    @pytest.mark.parametrize(
        ("token", "neighbours", "finding"),
        [
            ("fine", "independent", "two instances in two threads give the same as in one"),
            (
                "strtok",
                "one initialization at a time",
                "two instances in two threads do not give the same as in one",
            ),
            ("static buffer", "libraries", "a step writes to data that all instances"),
        ],
    )
    def test_tell_what_disturbs(self, folder, token, neighbours, finding):
        fmu = fmugym.FMU(make_fmu(folder, token))
        spec = PoolSpec((fmu.variable("u"),), (fmu.variable("y"),), STEP)
        verdict = examine(fmu, spec, num_instances=2, length=50)
        assert verdict.neighbours == neighbours
        assert finding in " ".join(verdict.findings)

    def test_of_steps_that_disturb_each_other(self, folder, caplog):
        path = make_fmu(folder, "static buffer")
        envs = fmugym.FMUVectorEnv(lambda: DemandingEnv(path), 2)
        envs.close()
        assert known_verdict(fmugym.FMU(path)).neighbours is Neighbours.LIBRARIES
        assert "each gets a copy of the library" in caplog.text
