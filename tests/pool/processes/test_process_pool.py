"""FMUs that end, hang or harm their process: the caller's own goes on, and nothing is left behind.

That the pool is otherwise like any other is shown by test_pool.py.
"""

import contextlib
import gc
import logging
import os
import pickle
import re
import signal
import subprocess
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from process_tools import (
    FaultyEnv,
    faulty_fmu,
    fixture_faulty,  # noqa: F401  # the fixture "faulty"
    is_alive,
    linux_only,
    no_descriptors_left,
    posix_only,
    processes_with,
    run_python,
    start_values,
    wait_until,
)

from fmugym import FMU, FMULoadError, SimulationError, _native, bundled_fmu
from fmugym.fmi import Status
from fmugym.pool import PoolSpec, opening
from fmugym.pool.engine import Request
from fmugym.pool.opening import PoolOptions
from fmugym.pool.pool_spec import ResetMethod
from fmugym.pool.processes import guard, launcher
from fmugym.pool.processes import supervisor as supervising
from fmugym.pool.processes.launcher import _guard
from fmugym.pool.processes.process_pool import ProcessPool

LOG = logging.getLogger("fmugym.test")

each_death = pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("crash", "SIGSEGV"),
        ("abort", "SIGABRT"),
        ("exit", "exit status 0"),
        ("close", "worker process"),
        ("hang", "took longer than call_timeout"),
    ],
)


@pytest.fixture(name="make_env")
def fixture_make_env(faulty, opened):
    def make(*args, **config):
        call_timeout = 0.7 if "hang" in args else 20.0
        return opened(FaultyEnv(faulty, *args, call_timeout=call_timeout, **config))

    return make


@pytest.fixture(name="make_pool")
def fixture_make_pool(faulty, opened):
    def make(num_instances=1, path=faulty, **options):
        fmu = FMU(path)
        outputs = tuple(map(fmu.variable, ["y", "fault"]))
        spec = PoolSpec((fmu.variable("u"),), outputs, time_step=0.5, num_observed=1)
        options = {"isolation": "process", "workers": 2, "call_timeout": 20.0} | options
        return opened(opening.open_pool(fmu, spec, num_instances, LOG, PoolOptions(**options)))

    return make


def set_up(pool, faulty, fault, mask=None, **stage):
    """Reset with a fault for each instance."""
    fmu = FMU(faulty)
    columns = [list(start_values(one, **stage).values()) for one in fault]
    variables = tuple(fmu.variable(name) for name in start_values())
    return pool.reset(variables, np.array(columns, float).T, mask)


def step(pool, value=1.0, **options):
    return pool.step(np.full((1, pool.num_instances), value), **options)


INTERRUPTED = """
import signal, sys
from test_process_pool import LOG, set_up, step
from fmugym import FMU
from fmugym.pool import PoolSpec
from fmugym.pool.opening import open_pool
from fmugym.pool.opening import PoolOptions

path = sys.argv[1]
fmu = FMU(path)
spec = PoolSpec((fmu.variable("u"),), (fmu.variable("y"),), time_step=0.5)
pool = open_pool(fmu, spec, 2, LOG, PoolOptions(isolation="process", workers=2, call_timeout=None))
set_up(pool, path, ["hang", "none"], at=1)

def interrupt(*_):
    raise KeyboardInterrupt

signal.signal(signal.SIGALRM, interrupt)
signal.setitimer(signal.ITIMER_REAL, 0.1)
try:
    step(pool)
except KeyboardInterrupt:
    print("interrupted" in pool.failure(0))
set_up(pool, path, ["none", "none"])
print(step(pool)[0][0].tolist())
pool.close()
"""


class TestSingle:
    @each_death
    def test_the_episode_is_truncated_and_the_next_one_goes_well(self, make_env, fault, cause):
        env = make_env(fault)
        for _ in range(2):
            env.reset()
            assert env.step([1.0])[0] == [0.5]
            observation, reward, terminated, truncated, info = env.step([1.0])
            assert (observation.tolist(), reward, terminated, truncated) == (
                [0.5],
                0.0,
                False,
                True,
            )
            assert "Faulty.fmu" in info["fault"]
            assert "in a step" in info["fault"] or "for a step" in info["fault"]
            assert cause in info["fault"]

    def test_last_words_are_told(self, make_pool, faulty):
        pool = make_pool()
        set_up(pool, faulty, ["crash"], at=1)
        assert step(pool)[1].tolist() == [Status.FATAL]
        assert pool.failure(0).endswith("; the FMU said: [last words] this is fault 1")

    @pytest.mark.parametrize("size", [8, 48, 152, 400, 4096])
    def test_the_latest_bytes_of_last_words_are_kept(self, opened, monkeypatch, size):
        for module in ("worker_setup", "shared_memory"):
            monkeypatch.setattr(f"fmugym.pool.processes.{module}.ECHO_SIZE", size)
        fmu = FMU(bundled_fmu("CartPole"))
        pool = opened(ProcessPool(fmu, PoolSpec((), (fmu.variable("x"),), 0.05), 1, LOG))
        for _ in range(5):
            pool.reset((fmu.variable("m_cart"),), np.array([[-1.0]]))
        memory = pool._group.supervisors[0]._echo.tobytes()
        text, _, rest = memory.partition(b"\0")
        message = (
            "[logStatusError] fmi2ExitInitializationMode: m_cart, m_pole and pole_length must be "
        )
        everything = 5 * f"{message}positive\n"
        assert text.decode() == everything[-size + 1 :]
        assert set(rest) <= {0}

    @pytest.mark.parametrize("stage", ["terminate", "free"])
    def test_the_end_of_an_instance(self, make_env, stage, caplog):
        env = make_env("crash", stage)
        env.reset()
        (pid,) = env.pool.processes()
        env.close()
        assert not is_alive(pid)
        assert "SIGSEGV in its end" in caplog.text

    @pytest.mark.parametrize(("number", "cause"), [(1, "SIGSEGV"), (3, "exit status 0")])
    def test_instantiation(self, tmp_path, temp_root, number, cause):
        path = faulty_fmu(tmp_path, f"{{faulty-{number}}}")
        with pytest.raises(FMULoadError, match=f"{cause} in the instantiation"):
            FaultyEnv(path)
        assert list(temp_root.iterdir()) == []

    def test_a_reset_that_ends_the_process_is_done_by_the_next_one(self, make_env):
        env = make_env("crash", "reset")
        for _ in range(3):
            env.reset()
            assert env.step([1.0])[0] == [0.5]

    def test_a_process_that_ends_in_each_reset(self, make_env):
        env = make_env("abort", "exit")
        for _ in range(5):
            with pytest.raises(SimulationError, match="SIGABRT in a reset"):
                env.reset()
        with pytest.raises(SimulationError, match=r"given up after 5 deaths in a row: .*SIGABRT"):
            env.reset()

    def test_pickles_with_its_isolation(self, make_env, opened):
        env = make_env("crash")
        twin = opened(pickle.loads(pickle.dumps(env)))
        assert twin.pool.processes() != env.pool.processes()
        for one in (env, twin):
            one.reset()
            assert one.step([1.0])[0] == [0.5]
            assert one.step([1.0])[3]


class TestVector:
    @linux_only
    def test_from_make_vec(self, opened, temp_root):
        options = {"isolation": "process", "workers": 3}
        opened(gymnasium.make_vec("fmugym/CartPole-v0", num_envs=5, **options))
        assert len(processes_with(temp_root)) == 3


@linux_only
class TestTraced:
    """An FMU that has itself traced: the guard is its parent, and no debugger."""

    @pytest.mark.parametrize(
        ("fault", "cause"),
        [
            ("traced", "took longer than call_timeout"),
            ("traced by child", "took longer than call_timeout"),
            ("traced and stop", "took longer than call_timeout"),
            ("traced and crash", "SIGSEGV"),
        ],
    )
    def test_its_episode_ends_and_others_go_on(self, make_pool, faulty, fault, cause):
        other = make_pool(1)
        set_up(other, faulty, ["none"])
        pool = make_pool(2, call_timeout=0.7)
        for _ in range(2):
            set_up(pool, faulty, [fault, "none"], at=1)
            assert step(pool)[1].tolist() == [Status.FATAL, Status.OK]
            assert cause in pool.failure(0)
        set_up(pool, faulty, ["none"] * 2)
        assert step(pool)[0][0].tolist() == [0.5, 0.5]
        assert step(other)[0][0].tolist() == [0.5]


@linux_only
class TestReach:
    """One worker can reach nothing of the others by mistake."""

    def test_writes_to_descriptors_reach_nobody(self, make_pool, faulty):
        pool = make_pool(3, workers=3)
        set_up(pool, faulty, ["none", "scribble", "none"], at=1)
        for number in (1, 2, 3):
            outputs, statuses = step(pool)
            assert statuses.tolist() == [Status.OK] * 3
            assert outputs[0].tolist() == [0.5 * number] * 3
            np.testing.assert_array_equal(pool.observations[:, 0], [0.5 * number] * 3)
        assert pool.health()["steps"].tolist() == [3, 3, 3]

    @pytest.mark.parametrize("workers", [1, 3])
    def test_each_has_its_own_memory_and_descriptors(self, make_pool, workers):
        pool = make_pool(3, workers=workers)
        memories = []
        for pid in pool.processes():
            open_ones = sorted(int(one.name) for one in Path(f"/proc/{pid}/fd").iterdir())
            assert open_ones[:3] == [0, 1, 2]
            assert [one >= 512 for one in open_ones[3:]] == [True]
            lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
            memories += [line.split()[4] for line in lines if "memfd:fmugym" in line]
        assert len(memories) == len(set(memories)) == workers


@posix_only
class TestInterrupted:
    """Ctrl-C while workers start or end: the text says so, and the next reset works."""

    @pytest.fixture(name="interrupt")
    def fixture_interrupt(self, monkeypatch):
        """Let a function be interrupted once, before it does its work or after it."""

        def interrupt(owner, name, when, call=1):
            function, calls = getattr(owner, name), []

            def interrupted(*args, **options):
                calls.append(name)
                if when == "before" and len(calls) == call:
                    raise KeyboardInterrupt
                result = function(*args, **options)
                if when == "after" and len(calls) == call:
                    raise KeyboardInterrupt
                return result

            monkeypatch.setattr(owner, name, interrupted)

        return interrupt

    @pytest.mark.parametrize(
        ("owner", "name", "when"),
        [
            (supervising, "launch", "before"),
            (launcher._GuardedProcess, "confirm", "before"),
            (launcher._GuardedProcess, "confirm", "after"),
            (supervising.Supervisor, "begin", "after"),
            (supervising.Supervisor, "tell", "after"),
            (supervising.Supervisor, "finish_opening", "before"),
        ],
    )
    def test_a_start(self, make_pool, faulty, interrupt, monkeypatch, owner, name, when):
        monkeypatch.setattr(supervising.Supervisor, "start_ahead", lambda _: None)
        pool = make_pool(3, workers=3)
        set_up(pool, faulty, ["crash", "none", "crash"], at=1)
        step(pool)
        interrupt(owner, name, when)
        with pytest.raises(KeyboardInterrupt):
            set_up(pool, faulty, ["none"] * 3)
        for index in range(3):
            if pool.statuses[index]:
                assert re.search("SIGSEGV|interrupted", pool.failure(index))
        set_up(pool, faulty, ["none"] * 3)
        assert step(pool)[0][0].tolist() == [0.5] * 3
        assert all(pool.processes())

    @pytest.mark.parametrize("name", ["begin_closing", "reply", "bury", "start", "confirm"])
    @pytest.mark.parametrize("call", [1, 2])
    def test_an_end(self, opened, faulty, interrupt, name, call):
        """Each reset ends the workers."""
        fmu = FMU(faulty)
        spec = PoolSpec((fmu.variable("u"),), (fmu.variable("y"),), time_step=0.5)
        spec = spec.beginning_by(ResetMethod.PROCESS)
        pool = opened(ProcessPool(fmu, spec, 2, LOG, workers=2))
        set_up(pool, faulty, ["none"] * 2)
        interrupt(supervising.Supervisor, name, "before", call)
        with pytest.raises(KeyboardInterrupt):
            set_up(pool, faulty, ["none"] * 2)
        assert all(pool.failure(index) for index in range(2) if pool.statuses[index])
        set_up(pool, faulty, ["none"] * 2)
        assert step(pool)[0][0].tolist() == [0.5] * 2

    def test_is_no_death(self, make_pool, faulty, interrupt):
        """An FMU is given up after five deaths in a row, but not after as many interrupts."""
        pool = make_pool()
        for number in range(1, 8):
            interrupt(supervising.Supervisor, "reply", "before")
            with pytest.raises(KeyboardInterrupt):
                set_up(pool, faulty, ["none"])
            assert "interrupted" in pool.failure(0), number
        set_up(pool, faulty, ["none"])
        assert step(pool)[0][0].tolist() == [0.5]


@posix_only
class TestKilledFromOutside:
    """The system kills a worker, and its successors, too."""

    @pytest.fixture(name="killing")
    def fixture_killing(self, monkeypatch):
        """Kill workers that get a request, so many times."""

        def killing(request, times):
            tell, left = supervising.Supervisor.tell, [times]

            def tell_and_kill(supervisor, told, *arguments):
                if told == request and left[0] > 0:
                    left[0] -= 1
                    os.kill(supervisor.pid, signal.SIGKILL)
                tell(supervisor, told, *arguments)

            monkeypatch.setattr(supervising.Supervisor, "tell", tell_and_kill)

        return killing

    @pytest.mark.parametrize("request_", [Request.OPEN, Request.START])
    def test_others_go_on(self, faulty, make_envs, killing, request_):
        """One episode of a vector environment ends, and the next one begins."""
        envs = make_envs(lambda: FaultyEnv(faulty), 3, workers=3)
        envs.reset()
        envs.step(np.ones((3, 1), np.float32))
        os.kill(envs.pool.processes()[1], signal.SIGKILL)
        killing(request_, 2)
        truncated, infos = envs.step(np.ones((3, 1), np.float32))[3:]
        assert truncated.tolist() == [False, True, False]
        assert "SIGKILL" in infos["fault"][1]
        observations, _, _, truncated, _ = envs.step(np.ones((3, 1), np.float32))
        assert observations[:, 0].tolist() == [1.5, 0.0, 1.5]
        assert truncated.tolist() == [False] * 3

    def test_not_for_ever(self, faulty, make_env, killing):
        env = make_env()
        killing(Request.START, 100)
        with pytest.raises(SimulationError, match=r"given up after 5 deaths in a row: .*SIGKILL"):
            env.reset()


@posix_only
class TestShortages:
    """What the system refuses is blamed on the system; other workers' episodes go on."""

    def after_a_death(self, pool, faulty):
        """The first of two dies in a step; what a step gives after its reset."""
        assert step(pool)[1].tolist() == [Status.FATAL, Status.OK]
        assert "SIGSEGV in a step" in pool.failure(0)
        assert step(pool)[1].tolist() == [Status.FATAL, Status.OK]
        set_up(pool, faulty, ["none"] * 2, np.array([True, False]))
        return step(pool)

    def test_a_worker_that_dies_when_no_descriptor_is_left(self, make_pool, faulty):
        pool = make_pool(2)
        set_up(pool, faulty, ["crash", "none"], at=1)
        with no_descriptors_left():
            outputs, statuses = self.after_a_death(pool, faulty)
        assert statuses.tolist() == [Status.FATAL, Status.OK]
        assert outputs[0].tolist() == [0.0, 1.5]
        assert "Too many open files" in pool.failure(0)
        set_up(pool, faulty, ["none"] * 2)
        assert step(pool)[1].tolist() == [Status.OK] * 2

    @pytest.mark.parametrize("left", range(5))
    def test_a_pool_without_descriptors(self, make_pool, left):
        make_pool().close()  # the guard is there
        with no_descriptors_left(left), pytest.raises(FMULoadError, match="Too many open files"):
            make_pool(3, workers=3)

    def test_no_process_can_be_forked(self, make_pool, faulty, monkeypatch, tmp_path):
        """The guard lives on, and so do its other workers."""
        popen, forking = subprocess.Popen, tmp_path / "forking.py"
        forking.write_text(FORKS_BUT_THE_THIRD)
        monkeypatch.setattr(
            subprocess,
            "Popen",
            lambda args, **options: popen([*args[:3], str(forking), *args[3:]], **options),
        )
        launcher._guards.clear()
        pool = make_pool(2)
        set_up(pool, faulty, ["crash", "none"], at=1)
        outputs, statuses = self.after_a_death(pool, faulty)
        assert statuses.tolist() == [Status.OK] * 2
        assert outputs[0].tolist() == [0.5, 1.5]
        pool.close()
        launcher._guards.clear()

    def test_no_temporary_folder(self, make_pool, monkeypatch, tmp_path):
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
        with pytest.raises(FMULoadError, match=r"no temporary folder can be made: .*missing"):
            make_pool()

    def test_a_full_temporary_folder(self, make_pool):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
        try:
            with pytest.raises(FMULoadError, match=r"Faulty.fmu cannot be .*large"):
                make_pool()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class TestOptions:
    @pytest.mark.parametrize("value", [1e9, 1e308, 10**12, np.float32(50.0), None])
    def test_long_call_timeouts(self, make_pool, faulty, value):
        """They wait that long: the slow answer comes after the first look."""
        pool = make_pool(call_timeout=value)
        set_up(pool, faulty, ["pause"], at=1)
        assert step(pool)[1].tolist() == [Status.OK]
        with contextlib.closing(pool):
            os.kill(pool.processes()[0], signal.SIGKILL)
            assert step(pool)[1].tolist() == [Status.FATAL]


FORKS_BUT_THE_THIRD = """
import errno, itertools, os
def limited(fork=os.fork, count=itertools.count(1)):
    if next(count) == 3:
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
    return fork()
os.fork = limited
import runpy, sys
sys.argv[:] = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


class TestPool:
    def test_blocks_and_processes(self, make_pool):
        assert len(set(make_pool(5, workers=3).processes())) == 3
        assert len(make_pool(2, workers=9).processes()) == 2

    @linux_only
    def test_workers_load_nothing_but_the_extension(self, make_pool):
        (worker,) = make_pool(1).processes()
        maps = Path(f"/proc/{worker}/maps").read_text()
        assert _native.__file__ in maps
        assert str(Path(np.__file__).parent) not in maps
        command = Path(f"/proc/{worker}/cmdline").read_text().split("\0")
        assert command[1:4] == ["-I", "-S", guard.__file__]

    def test_lost_instances_stay_so_until_their_own_reset(self, make_pool, faulty):
        pool = make_pool(4)
        set_up(pool, faulty, ["crash", "none", "none", "none"], at=1)
        assert step(pool)[1].tolist() == [4, 4, 0, 0]
        set_up(pool, faulty, ["none"] * 4, np.array([False, True, False, False]))
        outputs, statuses = step(pool)
        assert statuses.tolist() == [4, 0, 0, 0]
        assert outputs[0].tolist() == [0.0, 0.5, 1.0, 1.0]
        assert "SIGSEGV" in pool.failure(0)
        assert pool.step_own() == 1
        set_up(pool, faulty, ["none"] * 4)
        assert step(pool)[1].tolist() == [0] * 4

    def test_a_skipped_instance_cannot_die(self, make_pool, faulty):
        pool = make_pool(2)
        set_up(pool, faulty, ["crash", "none"], at=1)
        assert step(pool, skip=np.array([True, False]))[1].tolist() == [0, 0]
        assert step(pool)[1].tolist() == [4, 0]

    def test_snapshots_go_with_their_process(self, make_pool, faulty):
        pool = make_pool(2)
        set_up(pool, faulty, ["crash", "none"], at=2)
        step(pool)
        snapshot = pool.save()
        assert step(pool)[1].tolist() == [4, 0]
        with pytest.raises(SimulationError, match="SIGSEGV"):
            pool.restore(snapshot)
        with pytest.raises(SimulationError, match="SIGSEGV"):
            pool.save()
        set_up(pool, faulty, ["none", "none"])
        with pytest.raises(SimulationError, match="has been replaced since"):
            pool.restore(snapshot)
        outputs, _ = pool.restore(snapshot, np.array([False, True]))
        assert outputs[0].tolist() == [0.0, 0.5]

    def test_reading_is_refused_while_instances_are_lost(self, make_pool, faulty):
        pool = make_pool(2)
        set_up(pool, faulty, ["crash", "none"], at=1)
        step(pool)
        with pytest.raises(SimulationError, match="SIGSEGV"):
            pool.read((FMU(faulty).variable("y"),))

    @posix_only
    def test_an_interrupted_call(self, faulty):
        """A reply that comes late must not be taken for that of the next call.

        In a process of its own: an exception out of a signal handler leaves coverage's lock locked.
        """
        done = run_python("-c", INTERRUPTED, faulty)
        assert done.stdout.splitlines() == ["True", "[0.5, 0.5]"], done.stderr

    @posix_only
    @pytest.mark.parametrize("when", ["before", "after"])
    def test_without_a_working_directory(self, make_pool, faulty, monkeypatch, tmp_path, when):
        """Workers start although theirs was removed before, or after the pool was made."""
        directory = tmp_path / "away"
        directory.mkdir()
        monkeypatch.chdir(directory)
        if when == "before":
            directory.rmdir()
        pool = make_pool()
        if when == "after":
            directory.rmdir()
        os.kill(pool.processes()[0], signal.SIGKILL)
        step(pool)
        set_up(pool, faulty, ["none"])
        assert step(pool)[0][0].tolist() == [0.5]

    def test_several_at_once(self, make_pool, faulty):
        first, second = make_pool(2), make_pool(3)
        set_up(first, faulty, ["none"] * 2)
        set_up(second, faulty, ["none", "none", "crash"], at=1)
        step(second)
        assert step(first)[0][0].tolist() == [0.5, 0.5]
        first.close()
        set_up(second, faulty, ["none"] * 3)
        assert step(second)[0][0].tolist() == [0.5] * 3

    def test_without_its_guard(self, make_pool, faulty):
        pool = make_pool()
        set_up(pool, faulty, ["none"])
        os.kill(_guard().pid, signal.SIGKILL)
        wait_until(lambda: not any(map(is_alive, pool.processes())))
        assert step(pool)[1].tolist() == [Status.FATAL]
        set_up(pool, faulty, ["none"])
        assert step(pool)[1].tolist() == [Status.OK]

    @linux_only
    def test_deaths_leave_nothing(self, make_pool, faulty, temp_root):
        pool = make_pool()

        def die():
            set_up(pool, faulty, ["crash"], at=1)
            step(pool)
            return len(os.listdir("/proc/self/fd")), len(list(temp_root.iterdir()))

        gc.collect()  # pools of other tests
        first = [die() for _ in range(3)][-1]
        assert [die() for _ in range(10)] == [first] * 10


class TestChoice:
    """An FMU whose second instance fails, though it has a copy of the library."""

    def test_one_process_for_each_instance(self, make_pool, tmp_path, caplog):
        path = faulty_fmu(tmp_path, "{lonely}")
        pool = make_pool(3, path, isolation=None, workers=None)
        assert isinstance(pool, ProcessPool)
        assert len(pool.processes()) == 3
        assert "each gets a process" in caplog.text

    def test_by_its_own_word(self, make_pool, tmp_path, caplog):
        flag = 'canBeInstantiatedOnlyOncePerProcess="true"'
        alone = faulty_fmu(tmp_path / "1", "{lonely}", flag)
        assert isinstance(make_pool(2, alone, isolation=None, workers=None), ProcessPool)
        path = faulty_fmu(tmp_path / "2", capabilities=flag)
        pool = make_pool(2, path, isolation=None, workers=None)
        assert len(pool.processes()) == 2
        assert "a process may have one instance of" in caplog.text
        assert not isinstance(make_pool(1, path, isolation=None, workers=None), ProcessPool)

    def test_unless_the_caller_insists(self, make_pool, tmp_path):
        flag = 'canBeInstantiatedOnlyOncePerProcess="true"'
        path = faulty_fmu(tmp_path, capabilities=flag)
        assert not isinstance(make_pool(2, path, isolation="none", workers=None), ProcessPool)
        options = {"isolation": None, "workers": None, "private_libraries": True}
        assert not isinstance(make_pool(2, path, **options), ProcessPool)

    def test_with_isolation_asked_for(self, make_pool, tmp_path):
        path = faulty_fmu(tmp_path, "{lonely}")
        assert len(make_pool(2, path, workers=None).processes()) == 2
