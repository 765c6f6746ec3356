"""FMUs that take long to initialize: they are given time, and told of."""

import logging
import re
import sys
import time

import numpy as np
import pytest
from demanding_tools import DemandingEnv, expected_outputs, make_fmu

import fmugym
from fmugym.pool import licences
from fmugym.pool.trial.verdict import known_verdict

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

EXPECTED = expected_outputs(1.5, [0.5])[-1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("slow")


@pytest.fixture(autouse=True)
def no_licences(own_trials, monkeypatch):
    monkeypatch.setenv("LICENCES", "")


def step_once(env):
    env.reset(seed=0)
    env.step(np.array([0.5], np.float32))
    return float(env.state[0])


class TestTime:
    """An initialization may take ten times as long as other calls; here it takes 0.75 s."""

    def test_is_given_in_a_trial(self, folder):
        path = make_fmu(folder, "slower")
        DemandingEnv(path, probe_timeout=0.5).close()
        assert known_verdict(fmugym.FMU(path)).complete

    def test_is_given_in_worker_processes(self, folder):
        config = {"isolation": "process", "call_timeout": 0.5, "probe_timeout": None}
        env = DemandingEnv(make_fmu(folder, "slower"), **config)
        assert step_once(env) == EXPECTED
        env.close()

    def test_of_a_trial_ends(self, folder):
        start = time.monotonic()
        with pytest.raises(fmugym.FMULoadError) as caught:
            DemandingEnv(make_fmu(folder, "slow for ever"), probe_timeout=0.3)
        assert 3.0 <= time.monotonic() - start < 30.0
        text = str(caught.value)
        assert "in initialization it did not come back" in text
        assert "within 3 s (ten times probe_timeout)" in text
        assert "solving 4711 equations" in text

    def test_of_a_reset_in_a_worker_process_ends(self, folder):
        env = DemandingEnv(
            make_fmu(folder, "slow for ever"),
            isolation="process",
            call_timeout=0.1,
            probe_timeout=None,
        )
        with pytest.raises(fmugym.SimulationError) as caught:
            env.reset()
        env.close()
        text = str(caught.value)
        assert "took longer than ten times call_timeout for a reset" in text
        assert 1.0 <= float(re.search(r"ended after ([\d.]+) s", text)[1]) < 5.0
        assert "solving 4711 equations" in text

    def test_of_a_step_is_not_longer(self, folder):
        env = DemandingEnv(
            make_fmu(folder, "hangs in a step"),
            isolation="process",
            call_timeout=0.3,
            probe_timeout=None,
        )
        env.reset()
        *_, truncated, info = env.step(np.array([0.5], np.float32))
        env.close()
        assert truncated
        assert "took longer than call_timeout for a step" in info["fault"]
        assert 0.3 <= float(re.search(r"ended after ([\d.]+) s", info["fault"])[1]) < 2.0


class TestProgress:
    @pytest.fixture(autouse=True)
    def often(self, monkeypatch, caplog):
        monkeypatch.setattr(licences, "_EVERY", 0.1)
        caplog.set_level(logging.INFO, "fmugym")

    @pytest.mark.parametrize("config", [{}, {"isolation": "process", "call_timeout": 60.0}])
    def test_of_an_initialization_is_logged(self, folder, caplog, config):
        path = make_fmu(folder, "slow")
        env = DemandingEnv(path, probe_timeout=None, log_level=logging.INFO, **config)
        env.reset()
        env.close()
        pattern = r"Demanding.fmu: the initialization of 1 instance\(s\) has taken 0 s so far"
        assert re.search(pattern, caplog.text)

    def test_of_a_trial_is_logged(self, folder, caplog):
        DemandingEnv(make_fmu(folder, "slow")).close()
        text = "Demanding.fmu: the trial, in the comparison of state restores, has taken 0 s so far"
        assert text in caplog.text

    def test_is_not_logged_by_default(self, folder, caplog):
        caplog.set_level(logging.WARNING, "fmugym")
        env = DemandingEnv(make_fmu(folder, "slow"))
        env.reset()
        env.close()
        assert "has taken" not in caplog.text
