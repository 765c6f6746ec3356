"""First meetings: an FMU that kills its process does not kill the caller."""

import functools
import logging
import os
import shutil
import subprocess
import sys
import time

import building
import numpy as np
import pytest
from fmu_tools import PlainEnv, edited_fmu, grouped, library_name, write_fmu

import fmugym
from fmugym import FMU, ConfigError, FMULoadError, bundled_fmu
from fmugym.caching import cache_folder
from fmugym.pool import PoolSpec
from fmugym.pool.process.last_words import OutputTail, describe_exit
from fmugym.trial import attempt, trial
from fmugym.trial.known import known_verdict
from fmugym.trial.opening import make_pool

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="its faults are those of Unix")

XML = """<fmiModelDescription fmiVersion="2.0" modelName="Mortal" guid="{token}">
<CoSimulation modelIdentifier="Mortal"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
</ModelVariables><ModelStructure/></fmiModelDescription>"""
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

    def make(token="", **add):
        files = {
            "modelDescription.xml": XML.format(token=token),
            library_name(2, "Mortal"): building.library("mortal.c"),
        }
        return write_fmu(folder / token.replace(" ", "_") / "Mortal.fmu", files | add)

    return make


@pytest.fixture(autouse=True)
def trials(monkeypatch, tmp_path, temp_root, same_working_directory):
    """Trials as users have them, with a cache of their own; they leave nothing."""
    monkeypatch.delenv("FMUGYM_PROBE", raising=False)
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(tmp_path / "cache"))
    yield
    assert list(temp_root.iterdir()) == []


@pytest.fixture
def started(monkeypatch):
    """The workers that are started."""
    workers = []

    class Popen(subprocess.Popen):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            if attempt._WORKER in self.args:  # a fixture may start a compiler
                workers.append(self)

    monkeypatch.setattr(attempt.subprocess, "Popen", Popen)
    return workers


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

    def test_a_hang_ends_with_its_time(self, make_fmu, started):
        match = r"in the first step it did not come back within 1\.5 s \(probe_timeout\)"
        with pytest.raises(FMULoadError, match=match):
            step_once(make_fmu("hang in step"), probe_timeout=1.5)
        (worker,) = started
        assert worker.returncode == -9
        with pytest.raises(ProcessLookupError):
            os.killpg(worker.pid, 0)

    def test_is_not_remembered(self, make_fmu, started):
        path = make_fmu("licence")
        for count in (1, 2):
            with pytest.raises(FMULoadError):
                step_once(path)
            assert len(started) == count

    def test_before_a_vector_environment(self, make_fmu):
        with pytest.raises(FMULoadError, match="no licence for 5 seats"):
            fmugym.FMUVectorEnv(lambda: PlainEnv(make_fmu("licence"), CONFIG), 2)

    def test_of_a_second_instance_asks_for_libraries_of_their_own(self, make_fmu, caplog):
        path = make_fmu("lonely")
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
    environment = os.environ | {"PYTHONPATH": str(building.HERE)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "closed\n"), done.stderr
    assert known_verdict(FMU(path)).isolate


class TestIsolated:
    """Where the FMU runs in worker processes anyway, only a second instance is asked for."""

    @pytest.mark.parametrize(("token", "tried"), [("lonely", 2), ("segfault in step", 2)])
    def test_instances_that_want_a_process_each(self, make_fmu, started, token, tried):
        path = make_fmu(token)
        for _ in range(2):  # what one instance survives is remembered
            fmu = FMU(path)
            spec = PoolSpec((fmu.variable("u"),), (fmu.variable("y"),), 0.1)
            pool = make_pool(fmu, spec, 3, logging.getLogger("test"), isolation="process")
            assert len(set(pool.processes())) == 3
            pool.close()
        assert sum("fmugym.trial.worker" in process.args for process in started) == tried


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

    @pytest.mark.parametrize("token", ["noise", "deaf", "needy"])
    def test_whatever_it_says_closes_or_lacks(self, make_fmu, token):
        """What fails in order fails in the caller's process with its own message."""
        path = make_fmu(token)
        trial.meet(FMU(path))
        assert len(list(cache_folder().iterdir())) == 1

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
        trial.meet(FMU(bundled_fmu("Pendulum", "3.0")))
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
        monkeypatch.setattr(sys, "executable", "/nowhere/python")
        assert step_once(make_fmu()) == [1.0]
        assert "Mortal.fmu could not be tried before: it found no Python to start" in caplog.text

    def test_where_the_worker_fails_by_itself(self, make_fmu, monkeypatch, caplog):
        monkeypatch.setattr(attempt, "_WORKER", "fmugym.absent")
        assert step_once(make_fmu()) == [1.0]
        assert "No module named fmugym.absent" in caplog.text

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

    def test_a_tail_takes_no_more_memory_than_it_keeps(self, tmp_path):
        path = tmp_path / "output"
        path.write_bytes(b"x" * 10**7 + b"\n\n\xff\nlast\n")
        lines = OutputTail(path.open("rb")).lines(timeout=60)
        assert len(lines) == 10
        assert max(map(len, lines)) == 300
        assert lines[-2:] == ["\N{REPLACEMENT CHARACTER}", "last"]


def test_a_worker_ends_by_itself_when_its_parent_was_killed(make_fmu, tmp_path):
    """The trial's time goes on without the parent."""
    options = f"{str(make_fmu('hang in step'))!r}, probe_timeout=2"
    script = f"from fmugym import FMU; from fmugym.trial.trial import meet; meet(FMU({options}))"
    parent = subprocess.Popen([sys.executable, "-c", script])
    stage = wait_for(lambda: list((tmp_path / "temporary").glob("fmugym-probe-*/stage")))
    wait_for(lambda: stage[0].read_text() == "the first step")
    parent.kill()
    parent.wait()
    folder = stage[0].parent
    wait_for(lambda: not workers_of(folder))
    subprocess.run(["rm", "-r", *(tmp_path / "temporary").iterdir()], check=True)


def workers_of(folder):
    listing = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True)
    return [line for line in listing.stdout.splitlines() if str(folder) in line]


def wait_for(condition):
    deadline = time.monotonic() + 30
    while not (result := condition()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return result
