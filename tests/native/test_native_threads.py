"""The native pool against threads, exceptions and signals: nothing that callers do breaks it."""

import concurrent.futures
import contextlib
import gc
import json
import logging
import os
import signal
import sys
import threading
from pathlib import Path

import building
import foreign_tank
import numpy as np
import pytest
from combinations import in_turn
from fmu_tools import PlainEnv, probe_config
from gymnasium import spaces
from process_tools import run_python
from pythonfmu.builder import FmuBuilder
from test_native_pool import busy_fmu, make
from ways import in_way

from fmugym import FMU, SimulationError, bundled_fmu
from fmugym.environment.vector import FMUVectorEnv
from fmugym.pool import PoolSpec
from fmugym.pool.native_pool import NativePool

HERE = Path(__file__).parents[1]
on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
on_posix = pytest.mark.skipif(os.name != "posix", reason="Windows has no timer signals")


# All calls against each other


@on_posix
@pytest.mark.parametrize("options", [("1",), ("2", "python")], ids=["C", "Python"])
def test_stress(options):
    """A short form of what ``sanitize.py`` does with sanitizers."""
    done = run_python(HERE / "tools" / "native_stress.py", 3, *options)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Traceback" not in done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["played"] > 10


def test_a_call_that_waits_while_another_closes(busy):
    """Those that come after the close are refused; none of them uses what is freed."""
    pool = make(NativePool, busy, ["work"], ["steps"], 2)
    pool.reset((), np.zeros((0, 2)))
    pool.step(np.full((1, 2), 1e3))
    refused = []

    def step():
        try:
            pool.step(np.full((1, 2), 5e4))
        except SimulationError as error:
            refused.append(str(error))

    threads = [threading.Thread(target=step) for _ in range(8)]
    for thread in threads:
        thread.start()
    pool.close()
    for thread in threads:
        thread.join()
    assert set(refused) <= {"the pool is closed"}
    for call in (pool.step_own, pool.save, lambda: pool.read(())):
        with pytest.raises(SimulationError, match="closed"):
            call()


@pytest.fixture(scope="session")
def busy(tmp_path_factory):
    return busy_fmu(tmp_path_factory.mktemp("busy"))


@pytest.fixture(scope="module")
def tank(tmp_path_factory):
    path = FmuBuilder.build_FMU(foreign_tank.__file__, dest=tmp_path_factory.mktemp("tank"))
    if not FMU(path).runs_here:
        pytest.skip("pythonfmu has no binary for this platform")
    return path


DEADLOCK = """
import sys, threading
import numpy as np
from test_native_pool import NativePool, make
from native_stress import counts

pool = make(NativePool, sys.argv[1], ["inflow"], ["level"], 3, threads=2)
pool.reset((), np.zeros((0, 3)))
sys.setswitchinterval(1e-5)

def step():
    for _ in range(2000):
        pool.step_own()
        counts["steps"] += 1

def ask():
    while thread.is_alive():
        pool.failure(0)
        pool.health()

thread = threading.Thread(target=step)
thread.start()
ask()
print(counts["steps"], flush=True)
import os
os._exit(0)  # pythonfmu may crash at the end of the interpreter
"""


def test_an_fmu_in_python_and_calls_from_several_threads(tank):
    """It needs the GIL while it is stepped: who has that must not wait for the pool."""
    done = run_python("-c", DEADLOCK, tank)
    assert done.stdout == "2000\n", done.stderr[-3000:]


REENTRANT = """
import builtins, os, sys
import foreign_tank
import numpy as np
from fmu_tools import PlainEnv, probe_config
from gymnasium import spaces
from process_tools import run_python
from pythonfmu.builder import FmuBuilder
from test_native_pool import NativePool, make

pool = make(NativePool, sys.argv[1], ["inflow"], ["level"], 2, threads=1)
pool.reset((), np.zeros((0, 2)))
builtins.pool, builtins.errors = pool, []
print(pool.step()[1].tolist(), builtins.errors)
sys.stdout.flush()
os._exit(0)
"""
CALLS_ITS_POOL = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real
import builtins

class Selfish(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.inflow = self.level = 0.0
        self.register_variable(Real("inflow", causality=Fmi2Causality.input))
        self.register_variable(Real("level", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        for call in (builtins.pool.step_own, lambda: builtins.pool.failure(0)):
            try:
                call()
            except RuntimeError as error:
                builtins.errors.append(str(error))
        return True
"""


def test_an_fmu_that_calls_its_own_pool_gets_an_error(tmp_path, tank):
    source = tmp_path / "selfish.py"
    source.write_text(CALLS_ITS_POOL)
    path = FmuBuilder.build_FMU(str(source), dest=tmp_path)
    done = run_python("-c", REENTRANT, path)
    expected = [0, 0], ["an FMU has called the pool that it is in"] * 4
    assert done.stdout == "{} {}\n".format(*expected), done.stderr[-3000:]


def test_a_snapshot_dropped_while_the_pool_is_busy_is_freed_with_the_next_one(probe):
    pool = make(NativePool, probe(), ["a"], ["live"], 1)
    pool.reset((), np.zeros((0, 1)))
    barrier = threading.Barrier(2)
    snapshots = [pool.save() for _ in range(200)]

    def drop():
        barrier.wait()
        while snapshots:
            snapshots.pop()

    thread = threading.Thread(target=drop)
    thread.start()
    barrier.wait()
    while thread.is_alive():
        pool.step_own()
    thread.join()
    pool.save()
    pool.step_own()
    assert pool.outputs.tolist() == [[1.0]]
    pool.close()


# Helpers


def test_threads_save_and_drop_snapshots_at_once():
    pool = make(NativePool, bundled_fmu("CartPole"), ["f"], ["x"], 2)
    pool.reset((), np.zeros((0, 2)))
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)

    def save(_):
        for _ in range(3000):
            pool.save()  # and drops it

    try:
        with concurrent.futures.ThreadPoolExecutor(4) as threads:
            assert list(threads.map(save, range(4))) == [None] * 4
    finally:
        sys.setswitchinterval(before)
        pool.close()


def helper_masks():
    """The blocked signals of all threads but the main one."""
    for task in Path("/proc/self/task").iterdir():
        if task.name != str(os.getpid()):
            lines = (task / "status").read_text().splitlines()
            yield int(next(line.split()[1] for line in lines if line.startswith("SigBlk")), 16)


@on_linux
def test_helpers_block_signals_but_those_of_their_own_faults():
    script = f"""
import sys
sys.path[:0] = {building.FOLDERS!r}
import test_native_pool, test_native_threads
before = len(list(test_native_threads.helper_masks()))
pool = test_native_pool.cart_pole(3)
test_native_pool.rollout(pool)
print([mask for mask in test_native_threads.helper_masks() if mask][-2:])
"""
    masks = json.loads(run_python("-c", script).stdout)
    assert len(masks) == 2
    for mask in masks:
        blocked = {number for number in range(1, 65) if mask >> (number - 1) & 1}
        assert {signal.SIGINT, signal.SIGTERM, signal.SIGALRM, signal.SIGCHLD} <= blocked
        faults = {"SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGABRT"}
        assert not blocked & {getattr(signal, name) for name in faults}


@on_linux
def test_a_crash_in_a_helper_is_reported_by_faulthandler(tmp_path):
    path = busy_fmu(tmp_path, "-DCRASH_IN_HELPER")
    script = f"""
import sys, faulthandler
sys.path[:0] = {building.FOLDERS!r}
faulthandler.enable()
import numpy as np, test_native_pool as t
pool = t.make(t.NativePool, {str(path)!r}, ["work"], ["steps"], 64, threads=2)
pool.reset((), np.zeros((0, 64)))
while True:
    pool.step(np.full((1, 64), 500.0))
"""
    done = run_python("-c", script)
    assert done.returncode == -signal.SIGSEGV
    assert "Fatal Python error: Segmentation fault" in done.stderr


# Exceptions of the receiver of messages


class Raising(logging.Handler):
    """Raises an exception at some of the messages, and keeps the others."""

    def __init__(self, error, at):
        super().__init__()
        self.error, self.at, self.texts = error, at, []

    def emit(self, record):
        self.texts.append(record.getMessage())
        if len(self.texts) == self.at:
            raise self.error


def logging_pool(probe, error, at, count=3):
    """A pool whose instances say something in each step."""
    log = logging.Logger("raising")
    handler = Raising(error, at)
    log.addHandler(handler)
    fmu = FMU(probe())
    pool = NativePool(fmu, PoolSpec((), (fmu.variable("steps"),), 0.1), count, log)
    pool.reset((fmu.variable("log_status"),), np.ones((1, count)))
    return pool, handler


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(3), ValueError("!")], ids=repr)
def test_an_exception_comes_out_of_the_step_that_was_done(probe, error):
    """It may be one of a signal handler, which runs wherever the main thread is."""
    pool, handler = logging_pool(probe, error, at=2)
    with pytest.raises(type(error)) as caught:
        pool.step()
    assert caught.value is error
    assert pool.outputs.tolist() == [[1.0, 1.0, 1.0]]
    pool.step()
    numbers = [int(text.split(":")[0].split("_")[1]) for text in handler.texts]
    first = min(numbers)
    before, after = (sorted(n - first for n in part) for part in (numbers[:3], numbers[3:]))
    assert before == after == [0, 1, 2], "those left come first"
    pool.close()


def test_an_exception_comes_out_in_its_own_thread(probe):
    """That of the other thread, whose step lasts longer, is not for this one."""
    raised, done = threading.Event(), threading.Event()
    mine, my_handler = logging_pool(probe, None, at=0, count=1)
    other, handler = logging_pool(probe, None, at=0, count=2)
    my_handler.emit = lambda _: raised.wait(30)

    def emit(_):
        if not raised.is_set():
            raised.set()
            raise ValueError("the other's")
        done.wait(30)

    def step_the_other():
        with pytest.raises(ValueError, match="the other's"):
            other.step()
        other.step()  # what was left

    handler.emit = emit
    with concurrent.futures.ThreadPoolExecutor(1) as executor:
        future = executor.submit(step_the_other)
        raised.wait(30)
        mine.step()
        done.set()
        future.result(30)
    mine.close()
    other.close()


def test_other_lost_exceptions_go_where_they_went_before(probe, monkeypatch):
    class Odd:
        def __del__(self):
            raise ValueError("in a destructor")

    lost = []
    monkeypatch.setattr(sys, "unraisablehook", lambda unraisable: lost.append(str(unraisable[1])))
    hook = sys.unraisablehook
    pool, handler = logging_pool(probe, None, at=0, count=1)
    handler.emit = lambda _: Odd() and None
    pool.step()
    pool.close()
    assert lost == ["in a destructor"]
    assert sys.unraisablehook is hook


class Talkative(PlainEnv):
    """Its FMU says something in each step."""

    def __init__(self, path):
        config = probe_config(model_output_names="sum", model_parameters={"log_status": 1})
        super().__init__(path, config, logging.WARNING)

    def _get_action_space(self):
        return spaces.Discrete(2)

    def _get_inputs(self):
        return 0.5 * self.action


@in_turn({"hooks": ["arrays"], "error": [KeyboardInterrupt(), ValueError("!")]})
def test_an_exception_does_not_repeat_a_step_of_a_vector_environment(probe, hooks, error):
    with contextlib.closing(FMUVectorEnv(in_way(hooks, lambda: Talkative(probe())), 2)) as envs:
        envs.reset()
        handler = Raising(error, at=2)
        logger = envs.get_attr("logger")[0]
        logger.addHandler(handler)
        with pytest.raises(type(error)):
            envs.step(np.array([0, 1]))
        logger.removeHandler(handler)
    steps = {text.partition("] ")[2] for text in handler.texts}
    assert len(steps) == 1, "only one step was done"


def test_an_exception_while_closing_leaves_nothing_open(probe, temp_root):
    pool, _ = logging_pool(probe, KeyboardInterrupt(), at=1)
    with pytest.raises(KeyboardInterrupt):
        pool.step()
    pool.close()
    gc.collect()
    assert list(temp_root.iterdir()) == []


SIGNALS = """
import builtins, logging, random, signal, sys
import numpy as np
from fmugym import FMU
from fmugym.pool import PoolSpec
from fmugym.pool.native_pool import NativePool

error, count = getattr(builtins, sys.argv[2]), int(sys.argv[3])
log = logging.Logger("signals")
log.addHandler(logging.NullHandler())
logging.logMultiprocessing = logging.logAsyncioTasks = False  # logging drops exceptions in there
fmu = FMU(sys.argv[1])
pool = NativePool(fmu, PoolSpec((), (fmu.variable("steps"),), 0.1), 3, log)
pool.reset((fmu.variable("log_status"),), np.ones((1, 3)))
entered = came_out = 0

def handle(*_):
    global entered
    entered += 1
    raise error

def step_until(number):
    while entered < number:
        pool.step_own()

signal.signal(signal.SIGALRM, handle)
hook, random = sys.unraisablehook, random.Random(0)
for number in range(1, count + 1):
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-4, 1e-3))
        step_until(number)
    except error:
        came_out += 1
pool.step_own()
assert sys.unraisablehook is hook
pool.close()
print(came_out, "of", count)
"""


@on_posix
@pytest.mark.parametrize("error", ["KeyboardInterrupt", "SystemExit", "TimeoutError"])
def test_a_signal_ends_a_loop_of_steps_that_log(probe, error):
    """Each step logs, so the handler mostly runs inside of the receiver, or just before it.

    In a process of its own: an exception out of a signal handler leaves coverage's lock locked.
    """
    done = run_python("-c", SIGNALS, probe(), error, 400)
    assert done.stdout == "400 of 400\n", done.stdout + done.stderr
    assert done.stderr == ""


def test_closing_from_inside_of_the_receiver(probe):
    fmu = FMU(probe())
    log = logging.Logger("closing")
    pool = NativePool(fmu, PoolSpec((), (fmu.variable("steps"),), 0.1), 3, log)
    handler = logging.Handler()
    handler.emit = lambda _: pool.close()
    log.addHandler(handler)
    pool.reset((fmu.variable("log_status"),), np.ones((1, 3)))
    assert pool.step_own() == 0
    with pytest.raises(SimulationError, match="closed"):
        pool.step_own()
