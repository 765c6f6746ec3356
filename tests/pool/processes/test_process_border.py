"""Workers that do not keep to the rules: their pool gets rid of them, and goes on."""

import contextlib
import logging
import socket
import struct
import threading
import time

import numpy as np
import pytest
from process_tools import linux_only

from fmugym import FMU, FMULoadError, SimulationError, bundled_fmu
from fmugym.pool import PoolSpec
from fmugym.pool.engine import Answer
from fmugym.pool.processes.process_pool import ProcessPool
from fmugym.pool.processes.shared_memory import Memory

LOG = logging.getLogger("fmugym.test")
HEAD = struct.Struct("=QQ")


class Impostor:
    """A worker in a thread of this process, which does what it likes after it was opened."""

    pid, sentinel = 0, None

    def __init__(self, behave, end):
        self._end = end.dup()
        self._thread = threading.Thread(target=self.run, args=(behave,), daemon=True)
        self._thread.start()

    def run(self, behave):
        with contextlib.suppress(OSError, struct.error):  # the pool has closed its end
            self.read()
            self.send(Answer.RESULT)
            behave(self)

    def read(self):
        _, size = HEAD.unpack(self._end.recv(HEAD.size, socket.MSG_WAITALL))
        return self._end.recv(size, socket.MSG_WAITALL) if size else b""

    def send(self, code, content=b"", size=None):
        self._end.sendall(HEAD.pack(code, len(content) if size is None else size) + content)

    def confirm(self):
        pass

    def kill(self):
        with contextlib.suppress(OSError):
            self._end.shutdown(socket.SHUT_RDWR)

    def exit_status(self, timeout):
        self._thread.join(timeout)
        return None if self._thread.is_alive() else 0

    def forget(self):
        self._end.close()


def text(value):
    data = value.encode() + b"\0"
    return struct.pack("=q", len(data)) + data + bytes(-len(data) % 8)


def flood(worker):
    """Messages without an end, in the place of an answer."""
    message = struct.pack("=qq", 0, 0) + text("info") + text("more")
    while True:
        worker.send(Answer.LOG, message)


def promise(worker):
    """A long answer, of which nothing comes."""
    worker.read()
    worker.send(Answer.RESULT, size=2**50)
    time.sleep(10.0)


def pretend(worker):
    """An instance that does not exist has failed."""
    worker.read()
    worker.send(Answer.TROUBLE, struct.pack("=qq", 7, 0))
    time.sleep(10.0)


def ignore(worker):
    """Nothing is read."""
    time.sleep(10.0)


@pytest.fixture(name="deceived")
def fixture_deceived(monkeypatch):
    """Make pools of impostors."""
    with contextlib.ExitStack() as stack:

        def make(behave, outputs=("x",)):
            launch = "fmugym.pool.processes.supervisor.launch"
            monkeypatch.setattr(launch, lambda end, *_: Impostor(behave, end))
            fmu = FMU(bundled_fmu("CartPole"))
            spec = PoolSpec((fmu.variable("f"),), tuple(map(fmu.variable, outputs)), 0.05)
            pool = ProcessPool(fmu, spec, 2, LOG, workers=1, call_timeout=0.5)
            stack.callback(pool.close)
            return pool

        yield make


@pytest.mark.parametrize(
    ("behave", "cause"),
    [
        (flood, "took longer than call_timeout"),
        (promise, "took longer than call_timeout"),
        (pretend, "has sent what is no answer"),
        (ignore, "took longer than call_timeout"),
    ],
)
def test_a_call_ends_in_time(deceived, behave, cause):
    pool = deceived(behave)
    pool.step(np.zeros((1, 2)))
    assert pool.statuses.tolist() == [4, 4]
    assert cause in pool.failure(0)


def test_a_request_that_nobody_reads(deceived):
    """It is larger than what the system keeps."""
    pool = deceived(ignore)
    states = [bytes(4 * 2**20)] * 2
    begin = time.monotonic()
    pool.restore_states(states, np.arange(2), np.arange(2))
    assert time.monotonic() - begin < 10.0
    with pytest.raises(SimulationError, match="took longer than call_timeout"):
        pool.save()


def test_opening_is_answered_by_nothing_else(deceived, monkeypatch):
    monkeypatch.setattr(Impostor, "run", lambda self, _: self.send(Answer.TROUBLE))
    with pytest.raises(FMULoadError, match="has sent what is no answer in the instantiation"):
        deceived(None)


def test_a_worker_of_another_version_refuses_to_open(monkeypatch):
    monkeypatch.setattr("fmugym.pool.pool_form._VERSION", 0)
    fmu = FMU(bundled_fmu("CartPole"))
    with pytest.raises(FMULoadError, match="is of another version of fmugym"):
        ProcessPool(fmu, PoolSpec((), (), 0.05), 1, LOG)


@linux_only
def test_shared_memory_cannot_be_shrunk():
    memory = Memory(PoolSpec((), (), 1.0), 1)
    with open(memory.descriptor, "r+b", closefd=False) as file, pytest.raises(PermissionError):
        file.truncate(1)
    memory.map[memory.size - 1] = 1
    memory.close()


@linux_only
@pytest.mark.parametrize("byte", [0, 127, 255])
def test_shared_memory_full_of_garbage_harms_no_later_episode(byte):
    fmu = FMU(bundled_fmu("CartPole"))
    spec = PoolSpec((fmu.variable("f"),), (fmu.variable("x"),), 0.05)
    with contextlib.closing(ProcessPool(fmu, spec, 2, LOG, workers=1, call_timeout=5.0)) as pool:
        rows = []
        for _ in range(2):
            pool.reset((), np.empty((0, 2)))
            outputs, statuses = pool.step(np.ones((1, 2)))
            assert not statuses.any(), pool.failure(0)
            rows.append(outputs.copy())
            np.frombuffer(pool.outputs.base, np.uint8)[:] = byte
            pool.step()  # of whatever the inputs are now
    np.testing.assert_array_equal(*rows)
