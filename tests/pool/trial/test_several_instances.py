"""Instances that disturb each other: every column of a vector environment is as a fresh instance.

And FMUs that keep something for long, or that cannot be freed early.
"""

import contextlib
import logging
import os
import subprocess
import sys

import building
import fresh
import numpy as np
import pytest
import quirk_table
from quirk_table import OUTPUTS
from test_quirks import QuirkEnv

import fmugym
from fmugym.pool.pool_spec import PoolSpec
from fmugym.pool.trial.trial import compare, examine
from fmugym.pool.trial.verdict import Neighbours, Verdict, known_verdict

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its library is made for Linux")

NUM_ENVS, STEP = 4, 0.01
LENGTH = 130
"""In steps; at step 100, one FMU has an event."""
KINDS = (
    *("heap model", "newest turns", "heap buffer", "shared outputs"),
    *("initialized together", "two slots", "static time", "static random numbers"),
    *("counts instances", "reset disturbs"),
)


@pytest.fixture(scope="module")
def make_fmu(tmp_path_factory):
    return quirk_table.making_quirks(tmp_path_factory.mktemp("quirks"))


@pytest.fixture(autouse=True)
def as_users_have_them(trials):
    """Trials; their verdicts are kept for all tests."""


def inputs_of(length, index):
    return np.sin(0.9 * np.arange(length) + index).astype(np.float32)


def expected_episode(path, gain, length, index):
    rows = [{"u": value} for value in inputs_of(length, index)]
    return fresh.play(path, OUTPUTS, rows, STEP, {"gain": gain, "tau": 0.3})


def make_vector(path, num_envs=NUM_ENVS, length=LENGTH, **options):
    config = {"time_step": STEP, "max_episode_steps": length}
    return fmugym.FMUVectorEnv(
        lambda: QuirkEnv(path, **config), num_envs, autoreset_mode="Disabled", **options
    )


def assert_all_right(envs, path):
    """Play all environments, and then one of them beside the others, which go on."""
    _, infos = envs.reset(seed=5)
    gains = infos["drawn"]["gain"].copy()
    actions = np.stack([inputs_of(LENGTH, i) for i in range(NUM_ENVS)], axis=1)[:, :, None]
    played = fresh.episodes(envs, actions)
    for index in range(NUM_ENVS):
        assert played[index] == expected_episode(path, gains[index], LENGTH, index), index


@pytest.mark.parametrize("token", KINDS)
class TestDisturbing:
    @pytest.mark.parametrize("options", [{}, {"threads": 1}, {"private_libraries": True}])
    def test_all_environments_are_right(self, make_fmu, token, options):
        path = make_fmu(token)
        with contextlib.closing(make_vector(path, **options)) as envs:
            assert_all_right(envs, path)

    @pytest.mark.parametrize("workers", [None, 2])
    def test_in_worker_processes(self, make_fmu, token, workers):
        """Each gets one; or, if there are fewer, a copy of the library."""
        path = make_fmu(token)
        options = {} if workers is None else {"workers": workers}
        with contextlib.closing(make_vector(path, isolation="process", **options)) as envs:
            assert len(set(envs.pool.processes())) == (workers or NUM_ENVS)
            assert_all_right(envs, path)

    def test_the_log_and_info_say_why(self, make_fmu, token, caplog, ran):
        path = make_fmu(token)
        make_vector(path).close()
        assert "disturb each other: each gets a copy of the library" in caplog.text
        assert "one thread" not in caplog.text
        verdict = known_verdict(fmugym.FMU(path))
        assert verdict.neighbours is Neighbours.LIBRARIES
        assert verdict.instances == NUM_ENVS
        assert any("do not give" in finding for finding in verdict.findings)
        shown = ran("info", path)
        assert all(finding in shown for finding in verdict.findings)


def spec_of(fmu):
    return PoolSpec((fmu.variable("u"),), tuple(map(fmu.variable, OUTPUTS)), STEP)


class TestOtherInstances:
    @pytest.mark.parametrize("token", ["heap model", "newest turns", "two slots"])
    def test_without_a_trial_they_are_compared_as_long(self, make_fmu, token):
        fmu = fmugym.FMU(make_fmu(token), probe_timeout=None)
        verdict = compare(fmu, spec_of(fmu), num_instances=NUM_ENVS, length=LENGTH)
        assert verdict.neighbours is Neighbours.LIBRARIES

    def test_a_third_one_asks_for_another_trial(self, make_fmu):
        """Two do not disturb each other; what was found of them does not hold for three."""
        fmu = fmugym.FMU(make_fmu("two slots", 3))
        task = {"length": 40}
        found = [
            examine(fmu, spec_of(fmu), num_instances=count, **task).neighbours
            for count in (1, 2, 3, 2)
        ]
        assert found == [None, "independent", "libraries", "libraries"]

    def test_a_fifth_one_does_not(self):
        verdict = Verdict(neighbours=Neighbours.INDEPENDENT, instances=4)
        assert verdict.covers(None, 1000)
        assert not Verdict(neighbours=Neighbours.INDEPENDENT, instances=2).covers(None, 3)


class TestLength:
    """The longest episode of a trial is as long as those of the task."""

    @pytest.mark.parametrize("token", ["long memory", "long memory of the library"])
    @pytest.mark.parametrize("length", [1200, None])
    def test_what_is_kept_for_long_is_found(self, make_fmu, token, length):
        path = make_fmu(token)
        env = QuirkEnv(path, time_step=STEP, max_episode_steps=length)
        with contextlib.closing(env):
            for steps in (1200, 200):
                env.reset(seed=5)
                rows = fresh.episode(env, inputs_of(steps, 0)[:, None])
                assert rows == expected_episode(path, env.parameters["gain"], steps, 0)
        finding = " ".join(known_verdict(env.fmu).findings)
        assert "do not give the outputs of a fresh instance: in the episode after" in finding

    def test_a_longer_task_asks_for_another_trial(self, make_fmu, own_trials):
        fmu = fmugym.FMU(make_fmu("long memory", 3))
        found = [
            (str(verdict.reset_method), verdict.length)
            for verdict in (examine(fmu, spec_of(fmu), length=n) for n in (50, 40, 1100, 1000))
        ]
        assert found == [("restore", 50), ("restore", 50), ("instance", 1100), ("instance", 1100)]

    def test_what_the_fmu_ends_is_tried_once(self, make_fmu, own_trials, caplog):
        caplog.set_level(logging.INFO, "fmugym")
        fmu, told = fmugym.FMU(make_fmu("stops, reset keeps that")), []
        for length in (100, 1000, None):
            assert examine(fmu, spec_of(fmu), length=length).length is None
            told.append(len(caplog.records))
        assert told[0] > 0
        assert told == [told[0]] * 3

    def test_it_is_that_of_the_config_the_arguments_or_the_stop_time(self, make_fmu, own_trials):
        path, found = make_fmu("well behaved"), []
        fmu = fmugym.FMU(path)
        QuirkEnv(path, time_step=0.02, max_episode_steps=70).close()
        found.append(known_verdict(fmu).length)
        QuirkEnv(path, time_step=0.02, stop_time=1.5).close()
        found.append(known_verdict(fmu).length)
        make = lambda: QuirkEnv(path, time_step=0.04)  # noqa: E731
        fmugym.FMUVectorEnv(make, 2, max_episode_steps=80).close()
        found.append(known_verdict(fmu).length)
        assert found == [70, 75, 80]


EARLY = """
import sys, test_quirks
env = test_quirks.QuirkEnv(sys.argv[1], max_episode_steps=20)
if sys.argv[2] == "reset":
    env.reset()
env.close()
print("closed")
"""


@pytest.mark.parametrize("token", ["free before a step", "free before initialization"])
@pytest.mark.parametrize("until", ["open", "reset"])
def test_an_fmu_that_cannot_be_freed_early_runs_elsewhere(make_fmu, token, until):
    """The caller's process would be ended when the environment is closed."""
    command = [sys.executable, "-c", EARLY, make_fmu(token), until]
    environment = os.environ | {"PYTHONPATH": building.PATH}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "closed\n"), done.stderr
    harm = known_verdict(fmugym.FMU(make_fmu(token))).harm
    assert "in freeing an instance before its" in harm
    assert "signal SIGABRT" in harm


def test_findings_are_logged(make_fmu, caplog, tmp_path, monkeypatch):
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path))
    caplog.set_level(logging.INFO, "fmugym")
    fmu = fmugym.FMU(make_fmu("reset does nothing"))
    verdict = examine(fmu, spec_of(fmu), length=20)
    assert len(verdict.findings) >= 3
    assert all(f"Quirks.fmu: {finding}" in caplog.text for finding in verdict.findings)
