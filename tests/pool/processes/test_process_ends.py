"""What becomes of worker processes when they fork, or when the process that uses them ends."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time

import building
import pytest
from process_tools import (
    INTERRUPTIBLE,
    FaultyEnv,
    fixture_faulty,  # noqa: F401  # the fixture "faulty"
    is_alive,
    linux_only,
    posix_only,
    processes_of_session,
    processes_told_of,
    processes_with,
    wait_until,
)
from wine_tools import for_windows
from zoo_tools import ZooEnv, parameters, zoo_fmu

from fmugym.files import sweep
from fmugym.fmi.temporary import folder_name, make_folder
from fmugym.pool.processes.launcher import _guard
from fmugym.pool.processes.supervisor import Supervisor

FORKING_PROGRAM = """
import sys, time, zoo_tools
env = zoo_tools.ZooEnv(
    sys.argv[1], model_parameters=zoo_tools.parameters("fork", at=1), isolation="process"
)
env.reset()
env.step([1.0])
print("ready", flush=True)
time.sleep(60)
"""


@linux_only
class TestForks:
    """An FMU that forks: the new process has all that the worker has, its connection too."""

    @pytest.fixture(name="make")
    def fixture_make(self, tmp_path, opened):
        def make(fault, **config):
            config = {"isolation": "process", "call_timeout": 60.0} | config
            return opened(
                ZooEnv(zoo_fmu(tmp_path, 2), model_parameters=parameters(fault), **config)
            )

        return make

    def test_a_death_is_noticed_at_once(self, make, temp_root):
        env = make("fork_and_crash")
        env.reset()
        env.step([1.0])
        begin = time.monotonic()
        truncated, info = env.step([1.0])[3:]
        assert time.monotonic() - begin < 10.0
        assert truncated
        assert "ended with signal SIGSEGV in a step" in info["fault"]
        env.reset()
        assert len(processes_with(temp_root)) == 1
        env.close()
        assert processes_with(temp_root) == []

    def test_a_death_between_two_calls(self, make):
        env = make("fork")
        env.reset()
        for _ in range(2):
            assert not env.step([1.0])[3]
        os.kill(env.pool.processes()[0], signal.SIGKILL)
        assert "SIGKILL" in env.step([1.0])[4]["fault"]

    @pytest.mark.parametrize("fault", ["fork", "fork_and_loop"])
    def test_no_process_is_left(self, make, temp_root, fault):
        env = make(fault, call_timeout=0.7 if fault == "fork_and_loop" else 60.0)
        env.reset()
        fine = [not env.step([1.0])[3] for _ in range(2)]
        assert fine == [True, fault == "fork"]
        if fault == "fork":
            assert len(processes_with(temp_root)) == 2
        env.close()
        assert processes_with(temp_root) == []

    def test_a_twin_does_not_take_part(self, make, temp_root):
        """Its function returns in both processes."""
        env = make("fork_a_twin")
        for _ in range(3):
            env.reset()
            assert [env.step([1.0])[0].item() for _ in range(4)] == [0.5, 1.0, 1.5, 2.0]
        wait_until(lambda: len(processes_with(temp_root)) == 1)

    def test_a_killed_parent_leaves_none(self, tmp_path, temp_root):
        zoo_fmu(tmp_path, 2)
        program = subprocess.Popen(
            [sys.executable, "-c", FORKING_PROGRAM, tmp_path / "Zoo.fmu"],
            env=os.environ | {"PYTHONPATH": building.PATH},
            stdout=subprocess.PIPE,
            text=True,
        )
        with program:
            assert program.stdout.readline() == "ready\n"
            assert len(processes_with(temp_root)) == 2
            program.kill()
        wait_until(lambda: not processes_with(temp_root))


PROGRAM = """
import os, signal, sys, time
import process_tools
from fmugym.pool.processes.launcher import _guard

env = process_tools.FaultyEnv(sys.argv[1])
env.reset()
env.step([1.0])
print(*env.pool.processes(), _guard().pid, flush=True)
"""


def program_that_ends(end):
    return INTERRUPTIBLE + PROGRAM + textwrap.dedent(end)


KILLED = """
import importlib, os, signal, sys
import process_tools

def kill_in(module, path, when, number):
    *parts, name = path.split(".")
    owner = importlib.import_module(module)
    for part in parts:
        owner = getattr(owner, part)
    function, calls = getattr(owner, name), []

    def call(*args, **options):
        calls.append(name)
        if when == "before" and len(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        result = function(*args, **options)
        if len(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, call)

kill_in(*sys.argv[2:5], int(sys.argv[5]))
env = process_tools.FaultyEnv(sys.argv[1])
env.reset()
env.step([1.0])
os.kill(env.pool.processes()[0], signal.SIGKILL)
assert env.step([1.0])[3]
env.reset()
env.close()
"""
"""Ends when a function is called for the n-th time, or has been called."""

LAUNCHER, SUPERVISOR = "fmugym.pool.processes.launcher", "fmugym.pool.processes.supervisor"
MOMENTS = {
    "before it unpacks": ("zipfile", "ZipFile.extract", "before", 1),
    "while it unpacks": ("zipfile", "ZipFile.extract", "after", 1),
    "before the guard": ("subprocess", "Popen.__init__", "before", 1),
    "start of the guard": ("subprocess", "Popen.__init__", "after", 1),
    "before an order": ("socket", "send_fds", "before", 1),
    "in the middle of an order": ("socket", "send_fds", "after", 1),
    "start of a worker": (LAUNCHER, "_Guard.start", "after", 1),
    "a worker is there": (LAUNCHER, "_GuardedProcess.confirm", "after", 1),
    "instantiation": (SUPERVISOR, "Supervisor.finish_opening", "before", 1),
    "end of it": (SUPERVISOR, "Supervisor.finish_opening", "after", 1),
    "before the first reset": (SUPERVISOR, "Supervisor.reply", "before", 1),
    "after the first reset": (SUPERVISOR, "Supervisor.reply", "after", 1),
    "before a step": (SUPERVISOR, "Supervisor.step", "before", 1),
    "step": (SUPERVISOR, "Supervisor.step", "after", 1),
    "burial of a worker": (SUPERVISOR, "Supervisor.bury", "before", 1),
    "start of its successor": (LAUNCHER, "_Guard.start", "after", 2),
    "opening of its successor": (SUPERVISOR, "Supervisor.finish_opening", "before", 2),
    "end of a worker": (SUPERVISOR, "Supervisor.begin_closing", "after", 1),
    "removal of its files": ("shutil", "rmtree", "before", 1),
}
MOMENTS_OF_TRIAL = {
    **MOMENTS,
    "first episode": (SUPERVISOR, "Supervisor.reply", "before", 20),
    "comparison of resets": ("fmugym.pool.trial.reference", "Reference.worst", "before", 1),
    "verdict": ("os", "replace", "after", 1),
}
MOMENTS_IN_WINE = [
    *("start of a worker", "a worker is there", "instantiation", "after the first reset"),
    *("step", "start of its successor", "end of a worker"),
]


class TestKilled:
    """The parent is killed; what it has in memory has no name and goes with the processes."""

    @pytest.fixture(name="is_clean_after")
    def fixture_is_clean_after(self, faulty, temp_root, tmp_path):
        def is_clean_after(moment, probe, fmu=faulty):
            cache = tmp_path / "cache"
            program = subprocess.Popen(
                [sys.executable, "-c", KILLED, fmu, *map(str, moment)],
                env=os.environ
                | {"PYTHONPATH": building.PATH, "FMUGYM_PROBE": probe}
                | {"FMUGYM_CACHE_DIR": str(cache)},
                start_new_session=True,
            )
            assert program.wait() == -signal.SIGKILL
            wait_until(lambda: not processes_of_session(program.pid))
            wait_until(lambda: not processes_told_of(cache))
            sweep.cache_clear()
            sweep(temp_root)  # as the next process does that needs a folder
            assert list(temp_root.iterdir()) == []

        return is_clean_after

    @linux_only
    @pytest.mark.parametrize("moment", MOMENTS.values(), ids=MOMENTS)
    def test_of_a_known_fmu(self, is_clean_after, moment):
        is_clean_after(moment, "off")

    @linux_only
    @pytest.mark.parametrize("moment", MOMENTS_OF_TRIAL.values(), ids=MOMENTS_OF_TRIAL)
    def test_of_an_unknown_fmu(self, is_clean_after, moment):
        is_clean_after(moment, "on")

    @linux_only
    @pytest.mark.parametrize("moment", MOMENTS_IN_WINE)
    def test_of_an_fmu_in_wine(self, is_clean_after, wine, faulty, tmp_path, moment):
        copy_of_wine(wine, tmp_path / "cache")
        is_clean_after(MOMENTS[moment], "off", for_windows(faulty, tmp_path))


@linux_only
def test_an_interrupt_while_wine_starts(wine, faulty, tmp_path, monkeypatch):
    _guard()  # which is told nothing of this folder
    cache = copy_of_wine(wine, tmp_path / "cache")
    monkeypatch.setenv("FMUGYM_CACHE_DIR", str(cache))

    def interrupted(supervisor, deadline):
        raise KeyboardInterrupt

    monkeypatch.setattr(Supervisor, "finish_opening", interrupted)
    with pytest.raises(KeyboardInterrupt):
        FaultyEnv(for_windows(faulty, tmp_path))
    wait_until(lambda: not processes_told_of(cache))


def copy_of_wine(wine, cache):
    """A cache folder with a Wine of its own, because others may keep Wine's server busy."""
    left_out = shutil.ignore_patterns("server-*", "*.lock")
    shutil.copytree(wine.prefix.parent, cache / "wine", symlinks=True, ignore=left_out)
    return cache


class TestEndOfParent:
    @pytest.fixture(name="start")
    def fixture_start(self, faulty, temp_root):
        """Start a program; returns it and the numbers of its worker and of its guard."""
        programs = []

        def start(end):
            path = os.pathsep.join(filter(None, [building.PATH, os.environ.get("PYTHONPATH")]))
            program = subprocess.Popen(
                [sys.executable, "-W", "error", "-c", program_that_ends(end), faulty],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | {"PYTHONPATH": path},
                start_new_session=True,
            )
            programs.append(program)
            return program, [int(pid) for pid in program.stdout.readline().split()]

        yield start
        for program in programs:
            program.kill()
            program.communicate()

    @pytest.mark.parametrize("end", ["", "env.close()", "os._exit(0)", "sys.exit(0)", "del env"])
    def test_ordinary(self, start, temp_root, end):
        program, pids = start(end)
        assert program.communicate()[1] == ""
        wait_until(lambda: not any(map(is_alive, pids)))
        assert list(temp_root.iterdir()) == []

    @posix_only
    @pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
    def test_by_a_signal(self, start, temp_root, number):
        """A Ctrl-C goes to all processes of the terminal."""
        program, pids = start("time.sleep(60)")
        send = os.killpg if number == signal.SIGINT else os.kill
        send(program.pid, number)
        stderr = program.communicate()[1]
        assert "KeyboardInterrupt" in stderr if number == signal.SIGINT else stderr == ""
        wait_until(lambda: not any(map(is_alive, pids)))
        assert list(temp_root.iterdir()) == []

    @posix_only
    @pytest.mark.parametrize("call", ["env.step([1.0])", "env.reset()"])
    def test_by_ctrl_c_in_a_call(self, start, temp_root, call):
        program, pids = start(f"env.reset()\nprint('playing', flush=True)\nwhile True: {call}")
        assert program.stdout.readline() == "playing\n"
        time.sleep(0.1)
        os.killpg(program.pid, signal.SIGINT)
        assert "KeyboardInterrupt" in program.communicate()[1]
        wait_until(lambda: not any(map(is_alive, pids)))
        assert list(temp_root.iterdir()) == []

    @linux_only
    def test_while_the_fmu_hangs(self, start, temp_root):
        end = "env.reset(options={'model_parameters': process_tools.start_values('hang', at=1)})"
        program, pids = start(f"{end}; print('hanging', flush=True); env.step([1.0])")
        assert program.stdout.readline() == "hanging\n"
        program.kill()
        wait_until(lambda: not any(map(is_alive, pids)))
        wait_until(lambda: not list(temp_root.iterdir()))

    @linux_only
    def test_together_with_its_guard(self, start, temp_root):
        """Only the folder remains, until the next process that needs one."""
        program, pids = start("time.sleep(60)")
        os.kill(pids[-1], signal.SIGKILL)
        program.kill()
        program.communicate()
        wait_until(lambda: not any(map(is_alive, pids)))
        (left,) = temp_root.iterdir()
        sweep.cache_clear()
        made = folder_name()
        make_folder(made)
        assert not left.exists()
        sweep.cache_clear()
        sweep(temp_root)
        assert made.exists()

    @posix_only
    def test_a_fork_of_it_leaves_the_pool_alone(self, start):
        """The fork can neither use the pool nor take the folder away."""
        program, _ = start(
            """
            child = os.fork()
            if child == 0:
                try:
                    env.step([1.0])
                except Exception as error:
                    print(error, flush=True)
                sys.exit(0)
            os.waitpid(child, 0)
            print(env.step([1.0])[0])
            os.kill(env.pool.processes()[0], signal.SIGKILL)
            print("SIGKILL" in env.step([1.0])[4]["fault"])
            env.reset()
            print(env.step([1.0])[0])
            """
        )
        stdout, stderr = program.communicate()
        lines = stdout.splitlines()
        assert lines, stderr
        assert "the process that this one was forked from" in lines[0]
        assert lines[1:] == ["[1.]", "True", "[0.5]"]
        assert "Error" not in stderr
