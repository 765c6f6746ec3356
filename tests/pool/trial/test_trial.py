"""First meetings: an FMU that kills its process does not kill the caller."""

import functools
import logging
import os
import re
import shutil
import subprocess
import sys
import time

import building
import numpy as np
import pytest
from fmu_tools import PlainEnv, edited_fmu, grouped
from model_tools import model_fmu
from process_tools import linux_only, processes_with, wait_until

import fmugym
from fmugym import FMU, ConfigError, FMULoadError
from fmugym.files import cache_folder
from fmugym.pool import PoolSpec
from fmugym.pool.opening import PoolOptions, open_pool
from fmugym.pool.processes import launcher
from fmugym.pool.processes.channel import describe_exit
from fmugym.pool.trial import trial
from fmugym.pool.trial.verdict import known_verdict

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="its faults are those of Unix")

VARIABLES = (("u", "input", 'start="0"'), ("y", "output", ""))
CONFIG = {
    "model_input_names": "u",
    "model_output_names": "y",
    "time_step": 0.1,
    "bounds": {"u": (-1.0, 1.0)},
}


@pytest.fixture(scope="module")
def make_fmu(tmp_path_factory):
    """Make an FMU that does as it is told."""
    folder = tmp_path_factory.mktemp("mortal")

    def make(token=""):
        path = folder / token.replace(" ", "_") / "Mortal.fmu"
        return model_fmu(path, "mortal", 2, token, VARIABLES, flags="", name="Mortal")

    return make


@pytest.fixture(autouse=True)
def nothing_left(own_trials, temp_root, same_working_directory):
    """Trials as users have them leave nothing."""
    yield
    assert list(temp_root.iterdir()) == []


@pytest.fixture
def started(monkeypatch):
    """The trials that are started."""
    found = []

    class Workers(trial.Workers):
        def __init__(self, *args):
            super().__init__(*args)
            found.append(self)

    monkeypatch.setattr(trial, "Workers", Workers)
    return found


def spec_of(fmu):
    return PoolSpec((fmu.variable("u"),), (fmu.variable("y"),), 0.1)


def step_once(path, **config):
    env = PlainEnv(path, grouped(CONFIG | config))
    try:
        env.reset()
        return env.step(np.ones(1))[0].tolist()
    finally:
        env.close()


class TestDeath:
    def test_for_want_of_a_licence(self, make_fmu):
        with pytest.raises(FMULoadError) as caught:
            step_once(make_fmu("licence"))
        text = str(caught.value)
        assert "Mortal.fmu cannot be used: in loading and instantiation it ended" in text
        assert "signal SIGABRT" in text
        assert "[licence] no licence for 5 seats | so much for the licence. " in text
        assert "probe_timeout=None turns it off" in text

    @pytest.mark.parametrize(
        ("token", "match"),
        [
            ("exit", "in loading and inst.* with exit status 0; its last lines: good bye"),
            ("segfault in initialization", "in initialization it ended .* signal SIGSEGV"),
            ("segfault in step", "in the first step it ended .* signal SIGSEGV"),
            ("segfault in free", "in closing it ended .* signal SIGSEGV"),
        ],
    )
    def test_elsewhere(self, make_fmu, token, match):
        with pytest.raises(FMULoadError, match=match):
            step_once(make_fmu(token))

    @linux_only
    def test_a_hang_ends_with_its_time(self, make_fmu, temp_root):
        match = r"in the first step it did not come back within 1\.5 s \(probe_timeout\)"
        with pytest.raises(FMULoadError, match=match):
            step_once(make_fmu("hang in step"), probe_timeout=1.5)
        assert processes_with(temp_root) == []

    @pytest.mark.parametrize("token", ["hang in a later step", "hang in a later reset"])
    def test_a_hang_after_quick_calls_ends_soon(self, make_fmu, token):
        """Its limit follows from the calls before."""
        path, start = make_fmu(token), time.monotonic()
        PlainEnv(path, CONFIG).close()
        assert time.monotonic() - start < 40.0
        findings = " ".join(known_verdict(FMU(path)).findings)
        limit = re.search(r"did not come back within ([\d.]+) s \(those before took", findings)
        assert float(limit[1]) < 10.0

    def test_is_not_remembered(self, make_fmu, started):
        path = make_fmu("licence")
        for count in (1, 2):
            with pytest.raises(FMULoadError):
                step_once(path)
            assert len(started) == count

    def test_before_a_vector_environment(self, make_fmu):
        with pytest.raises(FMULoadError, match="no licence for 5 seats"):
            fmugym.FMUVectorEnv(lambda: PlainEnv(make_fmu("licence"), CONFIG), 2)

    @pytest.mark.parametrize("token", ["lonely", "free what is shared"])
    def test_of_a_second_instance_asks_for_libraries_of_their_own(self, make_fmu, caplog, token):
        path = make_fmu(token)
        for _ in range(2):  # found out, then remembered
            envs = fmugym.FMUVectorEnv(lambda: PlainEnv(path, CONFIG), 2)
            assert "disturb each other" in caplog.text
            caplog.clear()
            envs.reset()
            assert envs.step(np.ones((2, 1), np.float32))[0].tolist() == [[1.0], [1.0]]
            envs.close()


HEAP = """
import sys, numpy, fmu_tools
env = fmu_tools.PlainEnv(sys.argv[1], {config})
for _ in range(3):
    env.reset()
    for _ in range(50):
        env.step(numpy.ones(1))
env.close()
print("closed")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc checks the heap")
def test_an_instance_that_damages_its_heap_later_runs_elsewhere(make_fmu):
    """The caller would be ended when it closes the environment, if not before."""
    path = make_fmu("overrun later")
    code = HEAP.format(config=CONFIG)
    command = [sys.executable, "-c", code, path]
    environment = os.environ | {"PYTHONPATH": building.PATH}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "closed\n"), done.stderr
    assert known_verdict(FMU(path)).isolate


class TestIsolated:
    """Where the FMU runs in worker processes anyway, only a second instance is asked for."""

    @pytest.mark.parametrize(("token", "tried"), [("lonely", 1), ("segfault in step", 2)])
    def test_instances_that_want_a_process_each(self, make_fmu, started, token, tried):
        path = make_fmu(token)
        for _ in range(2):  # what one instance survives is remembered
            fmu = FMU(path)
            log = logging.getLogger("test")
            pool = open_pool(fmu, spec_of(fmu), 3, log, PoolOptions(isolation="process"))
            assert len(set(pool.processes())) == 3
            pool.close()
        assert len(started) == tried


class TestSurvival:
    def test_is_remembered_by_content(self, make_fmu, started, tmp_path):
        path = make_fmu()
        assert step_once(path) == [1.0]
        assert len(started) == 1
        copy = edited_fmu(path, tmp_path)
        copy.write_bytes(path.read_bytes())
        assert step_once(copy) == step_once(path) == [1.0]
        assert len(started) == 1
        assert step_once(edited_fmu(path, tmp_path, add={"extra": "1"})) == [1.0]
        assert len(started) == 2
        shutil.rmtree(cache_folder())
        step_once(path)
        assert len(started) == 3

    def test_a_verdict_is_remembered_by_what_was_tried(self, make_fmu, started):
        path = make_fmu()
        for step in (0.1, 0.2) * 2:
            config = CONFIG | {"time_step": step}
            fmugym.FMUVectorEnv(functools.partial(PlainEnv, path, config), 2).close()
        assert len(started) == 2
        step_once(path)  # what holds for several holds for one
        assert len(started) == 2

    @pytest.mark.parametrize("token", ["noise", "closes files", "needy"])
    def test_whatever_it_says_closes_or_lacks(self, make_fmu, token):
        """What fails in order fails in the caller's process with its own message."""
        fmu = FMU(make_fmu(token))
        assert trial.examine(fmu, spec_of(fmu)).complete
        assert known_verdict(fmu) is not None

    def test_a_refusal_is_the_callers_to_hear_each_time(self, make_fmu, started):
        path = make_fmu("refuse")
        for count in (1, 2):
            with pytest.raises(FMULoadError, match="all 5 seats are taken"):
                step_once(path)
            assert len(started) == count

    def test_without_a_place_to_remember(self, make_fmu, started, tmp_path, monkeypatch):
        (tmp_path / "file").write_text("")
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "file" / "cache"))
        assert step_once(make_fmu()) == [1.0]
        assert step_once(make_fmu()) == [1.0]
        assert len(started) == 2


class TestExemptions:
    def test_bundled_fmus(self, started):
        fmugym.FMUVectorEnv(fmugym.envs.CartPoleEnv, 2).close()
        assert started == []

    def test_by_argument(self, make_fmu, started):
        assert step_once(make_fmu(), probe_timeout=None) == [1.0]
        assert started == []

    @pytest.mark.parametrize("value", ["0", "off", "False"])
    def test_by_environment(self, make_fmu, started, monkeypatch, value):
        monkeypatch.setenv("FMUGYM_PROBE", value)
        assert step_once(make_fmu()) == [1.0]
        assert started == []

    @pytest.mark.parametrize(("value", "count"), [("", 1), ("on", 1), ("TRUE ", 1), ("No", 0)])
    def test_by_other_values(self, make_fmu, started, monkeypatch, value, count):
        monkeypatch.setenv("FMUGYM_PROBE", value)
        assert step_once(make_fmu()) == [1.0]
        assert len(started) == count

    @pytest.mark.parametrize("value", ["offf", "2", "none"])
    def test_not_by_unknown_values(self, make_fmu, started, monkeypatch, value):
        monkeypatch.setenv("FMUGYM_PROBE", value)
        with pytest.raises(ConfigError, match=f"variable FMUGYM_PROBE '{value}'; .*'o"):
            step_once(make_fmu())
        assert started == []

    def test_reading_is_no_meeting(self, make_fmu, started):
        assert FMU(make_fmu("licence")).variable("y").causality == "output"
        assert started == []

    def test_where_no_worker_can_be_started(self, make_fmu, monkeypatch, caplog):
        monkeypatch.setattr(launcher, "_guards", {})
        monkeypatch.setattr(launcher.multiprocessing.spawn, "get_executable", lambda: "/nowhere")
        assert step_once(make_fmu()) == [1.0]
        assert "Mortal.fmu could not be tried before: no worker process can be st" in caplog.text
        assert "No such file or directory: '/nowhere'" in caplog.text

    @pytest.mark.parametrize("timeout", [0, -1.0, float("nan"), "1"])
    def test_of_no_other_value(self, make_fmu, timeout):
        with pytest.raises(ConfigError, match="probe_timeout must be"):
            step_once(make_fmu(), probe_timeout=timeout)
        with pytest.raises(ConfigError, match="probe_timeout must be"):
            FMU(make_fmu(), probe_timeout=timeout)


class TestCacheFolder:
    @pytest.fixture(autouse=True)
    def elsewhere(self, monkeypatch, tmp_path):
        monkeypatch.delenv("FMUGYM_CACHE_DIR")
        monkeypatch.setenv("HOME", str(tmp_path))
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)

    @pytest.mark.parametrize(
        ("platform", "folder"),
        [("linux", ".cache/fmugym"), ("darwin", "Library/Caches/fmugym")],
    )
    def test_is_the_systems(self, monkeypatch, tmp_path, platform, folder):
        monkeypatch.setattr(sys, "platform", platform)
        assert cache_folder() == tmp_path / folder

    def test_is_where_the_user_wants_it(self, monkeypatch, tmp_path):
        monkeypatch.setattr(sys, "platform", "linux")
        monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # which the standard forbids
        assert cache_folder() == tmp_path / ".cache" / "fmugym"
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
        assert cache_folder() == tmp_path / "xdg" / "fmugym"
        monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "mine"))
        assert cache_folder() == tmp_path / "mine"


class TestLastWords:
    @pytest.mark.parametrize(
        ("code", "text"),
        [
            (0, "exit status 0"),
            (-11, "signal SIGSEGV"),
            (-64, "signal 64|signal SIGRTMAX"),
            (0xC0000005, "Windows error 0xc0000005"),
        ],
    )
    def test_how_a_process_ended(self, code, text):
        assert describe_exit(code) in text.split("|")


@linux_only
def test_a_worker_ends_within_a_second_when_its_parent_was_killed(make_fmu, temp_root):
    program = "import sys, test_trial; test_trial.step_once(sys.argv[1])"
    command = [sys.executable, "-c", program, make_fmu("hang in step")]
    with subprocess.Popen(command, env=os.environ | {"PYTHONPATH": building.PATH}) as parent:
        try:
            wait_until(lambda: processes_with(temp_root), 120.0)
        finally:
            parent.kill()
        wait_until(lambda: not processes_with(temp_root), 1.0)
    wait_until(lambda: not list(temp_root.iterdir()))
