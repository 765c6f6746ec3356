"""An FMU that crashes a process in training runs in worker processes the next time."""

import errno
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zoo_tools

from fmugym.pool import mark
from fmugym.pool.mark import remains_of

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="crashes are only noted on Linux"),
]

HOST = Path(__file__).with_name("crash_host.py")
FAULTS = {
    "segv": "signal SIGSEGV",
    "fpe": "signal SIGFPE",
    "ill": "signal SIGILL",
    "bus": "signal SIGBUS",
    "abort": "signal SIGABRT",
    "overflow": "signal SIGSEGV",
    "leave": "a call of exit",
}


class Place:
    """An FMU and a cache that knows it, for processes that the FMU may crash."""

    def __init__(self, folder):
        self.path, self.cache, self.log = folder / "Zoo.fmu", folder / "cache", folder / "log"

    def start(self, *wishes):
        environment = {k: v for k, v in os.environ.items() if k != "FMUGYM_PROBE"}
        environment |= {"FMUGYM_CACHE_DIR": str(self.cache), "HOST_LOG": str(self.log)}
        return subprocess.Popen(
            [sys.executable, HOST, self.path, *wishes],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, *wishes):
        """Let a process play; returns its answer, None if it died, with its exit status."""
        process = self.start(*wishes)
        output, errors = process.communicate(timeout=100)
        lines = [line for line in output.splitlines() if line.startswith("{")]
        return json.loads(lines[0]) if lines else None, process.returncode, errors

    def is_isolated(self, *wishes):
        answer, _, errors = self.run(*wishes)
        assert answer is not None, errors
        return answer["isolated"]

    @property
    def marks(self):
        return sorted((self.cache / "marks").glob("*"))


@pytest.fixture(scope="module")
def met(tmp_path_factory):
    """A place where the FMU has been tried."""
    folder = tmp_path_factory.mktemp("met")
    zoo_tools.zoo_fmu(folder, 2)
    place = Place(folder)
    answer, *_ = place.run()
    assert answer == {"isolated": False, "outcome": "", "warnings": [], "reasons": []}
    return place


@pytest.fixture
def place(met, tmp_path):
    shutil.copy(met.path, tmp_path)
    shutil.copytree(met.cache, tmp_path / "cache")
    return Place(tmp_path)


@pytest.mark.parametrize("backend", ["native"])
@pytest.mark.parametrize("fault", FAULTS)
def test_the_next_environment_is_isolated_and_goes_on(place, fault, backend):
    answer, code, _ = place.run(f"fault={fault}", f"backend={backend}")
    assert answer is None
    assert code == 0 if fault == "leave" else code < 0
    for _ in range(2):
        answer, code, _ = place.run(f"fault={fault}", f"backend={backend}")
        assert code == 0
        assert answer["isolated"]
        assert "worker process" in answer["outcome"]
        text = answer["warnings"][0]
        assert text.startswith("Zoo.fmu harms its process: in training, it ended its process with")
        assert f"{FAULTS[fault]} in a step. It runs in worker processes" in text
        assert place.marks == []


@pytest.mark.parametrize(
    ("call", "words"),
    [("enter", "an initialization"), ("get", "a reading of its outputs"), ("free", "its end")],
)
def test_the_call_is_named(place, call, words):
    place.run("fault=segv", f"call={call}", "at=0")
    answer, *_ = place.run()
    assert answer["reasons"][-1].endswith(f"with signal SIGSEGV in {words}")


def test_other_configs_of_the_fmu_are_isolated_too(place):
    assert not place.is_isolated("time_step=0.25")
    place.run("fault=segv")
    assert place.is_isolated()
    assert place.is_isolated("time_step=0.25")
    assert place.is_isolated("time_step=0.125")


@pytest.mark.parametrize("backend", ["native"])
def test_a_damaged_heap_that_ends_the_process_elsewhere(place, backend):
    answer, code, errors = place.run("do=damage", f"backend={backend}")
    assert answer is None
    assert code == -signal.SIGABRT
    assert place.marks
    answer, *_ = place.run(f"backend={backend}")
    assert answer["isolated"]
    said = next(line for line in errors.splitlines() if "()" in line)
    assert f"outside of its calls because the heap was damaged ({said})" in answer["warnings"][0]
    assert place.marks == []


def test_helper_threads_and_exhausted_stacks(place):
    place.run("vector", "fault=overflow")
    assert place.is_isolated()


@pytest.mark.parametrize("when", ["before", "after"])
def test_faulthandler_goes_on_working(place, when):
    _, code, errors = place.run("fault=segv", f"faulthandler={when}")
    assert code == -signal.SIGSEGV
    assert "Fatal Python error: Segmentation fault" in errors
    assert place.is_isolated()


@pytest.mark.parametrize("deed", ["null", "abort", "kill", "_exit", "exit", "fork"])
def test_what_the_fmu_has_not_done_changes_nothing(place, deed):
    answer, *_ = place.run(f"do={deed}")
    assert answer is None or deed == "fork"
    answer, *_ = place.run()
    assert not answer["isolated"]
    assert answer["warnings"] == answer["reasons"] == []
    assert place.marks == []


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV, signal.SIGABRT])
def test_signals_of_other_processes_change_nothing(place, number):
    process = place.start("fault=sleep", "do=wait")
    assert process.stdout.readline() == "waiting\n"
    process.stdin.write("\n")
    process.stdin.flush()
    time.sleep(0.3)  # it is in the FMU by then, and stays there
    process.send_signal(number)
    process.communicate(timeout=100)
    assert process.returncode == -number
    assert not place.is_isolated()


def test_a_signal_that_was_survived_changes_nothing(place):
    answer, code, _ = place.run("fault=fpe", "handler")
    assert code == 0, "the handler returns, and the step goes on"
    assert not answer["isolated"]
    place.run("fault=fpe", "handler", "do=kill")
    assert not place.is_isolated()


def test_processes_at_the_same_time(place):
    """One lives on while another one crashes; only the latter leaves a mark."""
    living = place.start("do=wait")
    assert living.stdout.readline() == "waiting\n"
    place.run("fault=segv")
    assert len(place.marks) == 2
    folder, key = place.cache / "marks", place.marks[0].name.partition("-")[0]
    both = [remains_of(folder, key).crashes for _ in range(2)]
    assert both[0] == both[1] == ["in training, it ended its process with signal SIGSEGV in a step"]
    assert place.is_isolated()
    assert len(place.marks) == 1
    output, _ = living.communicate("\n", timeout=100)
    assert not json.loads(output)["isolated"]
    assert place.marks == []


def test_where_nothing_can_be_kept(place):
    shutil.rmtree(place.cache)
    place.cache.write_text("no folder")
    answer, *_ = place.run("fault=segv")
    assert answer is None
    assert not place.is_isolated()
    assert "a crash would not be noted: " in place.log.read_text()


def test_on_a_full_disk(tmp_path, monkeypatch, caplog):
    def write(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(mark.os, "write", write)
    caplog.set_level(logging.DEBUG)
    assert mark.Mark.attempt(tmp_path, "key") is None
    assert list(tmp_path.iterdir()) == []
    assert "a crash would not be noted: [Errno 28]" in caplog.text


@pytest.mark.parametrize("wish", ["untried", "isolation=process"])
def test_without_a_trial_or_a_pool_in_this_process_there_is_no_mark(place, wish):
    process = place.start(wish, "do=wait")
    assert process.stdout.readline() == "waiting\n"
    assert place.marks == []
    process.communicate("\n", timeout=100)


def test_the_caller_may_insist(place):
    place.run("fault=segv")
    answer, *_ = place.run("isolation=none")
    assert not answer["isolated"]
    assert place.is_isolated()


def test_a_worker_that_crashes_isolates_later_environments(place):
    answer, *_ = place.run("isolation=process", "fault=segv")
    assert "signal SIGSEGV" in answer["outcome"]
    assert not any("harms" in text for text in answer["warnings"])
    answer, *_ = place.run()
    assert answer["isolated"]
    assert "a worker process ended with signal SIGSEGV in a step" in answer["warnings"][0]
