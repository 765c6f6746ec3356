"""Starts the processes of workers: with a fork server, or by spawning where there is none."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import multiprocessing.spawn
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Sequence
from multiprocessing.reduction import DupFd
from pathlib import Path
from typing import Any, Protocol

from fmugym.pool.process.fork_server import ANSWER, PROGRAM, Program
from fmugym.pool.process.shared_memory import Memory
from fmugym.pool.process.worker import run_worker
from fmugym.signals import Ignoring, ordinary

__all__ = ["Process", "launch", "launch_program"]


class Process(Protocol):
    """A worker's process.

    Attributes:
        pid: Its number.
        sentinel: A file descriptor that becomes readable when the process has ended; None where
            there is none.
    """

    pid: int
    sentinel: int | None

    def kill(self) -> None:
        """End the process at once, whatever it does."""
        ...

    def exit_status(self, patience: float) -> int | None:
        """Return the exit status, negative for a signal; None if it has not ended in time."""
        ...

    def forget(self) -> None:
        """Close what belongs to the process in this one, without ending it."""
        ...


def launch(end: socket.socket, memory: Memory, folder: Path, pipes: Sequence[int] = ()) -> Process:
    """Start a worker.

    Args:
        end: The worker's end of the channel. The caller may close it afterwards.
        memory: Shared with the worker.
        folder: Where its FMU was extracted to. It is removed if this process is killed.
        pipes: For its standard output and standard error; not used on Windows.

    Raises:
        OSError: If the system refuses.
    """
    if sys.platform == "win32":
        return _SpawnedProcess(end, memory)
    return _start(folder, memory.size, (end.fileno(), memory.descriptor, *pipes))


def launch_program(
    end: socket.socket, program: Program, folder: Path, pipes: Sequence[int]
) -> Process:
    """Start a worker that is a program; the channel is its standard input and output.

    Args:
        end: The worker's end of the channel. The caller may close it afterwards.
        program: What to start.
        folder: Where its FMU was extracted to. It is removed if this process is killed.
        pipes: Two, of which the second gets its standard error.

    Raises:
        OSError: If the system refuses.
    """
    with tempfile.TemporaryFile() as order:  # a request of the fork server is limited
        order.write(pickle.dumps(program))
        order.flush()
        return _start(folder, PROGRAM, (end.fileno(), order.fileno(), *pipes))


class _ForkServer:
    """This end of ``fmugym.pool.process.fork_server``; a process has at most one server."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            process = _run_fork_server(theirs)
            self._requests = ours.detach()  # a socket would complain at the interpreter's end
        self.pid = process.pid
        process.returncode = 0  # or else Popen would complain that it still runs
        self._stop = weakref.finalize(self, _stop, self._requests, self.pid)
        self._stop.atexit = False  # pools may still have to close their workers then

    def start(self, folder: Path, size: int, descriptors: Sequence[int]) -> _ForkedProcess:
        """Start a worker with a lifeline of its own, so that threads do not mix.

        Raises:
            EOFError: If the server has ended.
            OSError: If the system refuses.
        """
        ours, theirs = socket.socketpair()
        try:
            with theirs, socket.socket(fileno=os.dup(self._requests)) as requests:
                data = pickle.dumps((str(folder), size))
                socket.send_fds(requests, [data], [theirs.fileno(), *descriptors])
            return _ForkedProcess(ours)
        except BaseException:
            ours.close()
            raise

    def forget(self) -> None:
        """Let go of the server, because this process is a fork of the one that started it."""
        self._stop.detach()
        os.close(self._requests)


def _run_fork_server(requests: socket.socket) -> subprocess.Popen[bytes]:
    program = (
        f"import sys; sys.path[:] = {sys.path!r}; "
        "from fmugym.pool.process.fork_server import main; "
        f"main({requests.fileno()}, {os.getpid()})"
    )
    return subprocess.Popen(
        [multiprocessing.spawn.get_executable(), "-c", program],
        stdin=subprocess.DEVNULL,
        pass_fds=[requests.fileno()],
        # A process that forks should have no threads.
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
    )


def _stop(requests: int, pid: int) -> None:
    os.close(requests)
    with contextlib.suppress(ChildProcessError):
        os.waitpid(pid, 0)


@functools.cache
def _cached_fork_server() -> _ForkServer:
    return _ForkServer()


_making = threading.Lock()


def _fork_server() -> _ForkServer:
    """Return the server of this process; several threads may ask at the same time."""
    with _making:
        return _cached_fork_server()


def _start(folder: Path, size: int, descriptors: Sequence[int]) -> _ForkedProcess:
    """Start a worker with the fork server, or with a new one if the old one has ended."""
    try:
        return _fork_server().start(folder, size, descriptors)
    except ordinary(EOFError, BrokenPipeError, ConnectionResetError):
        _cached_fork_server.cache_clear()
        return _fork_server().start(folder, size, descriptors)


def _forget_fork_server() -> None:
    if _cached_fork_server.cache_info().currsize:
        _cached_fork_server().forget()
        _cached_fork_server.cache_clear()
    _making.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_making.acquire,
        after_in_parent=_making.release,
        after_in_child=_forget_fork_server,
    )


class _ForkedProcess:
    """A worker of the fork server.

    Args:
        lifeline: Gives the process number and the exit status. It is closed with the process.

    Raises:
        EOFError: If the server has ended.
        OSError: If the server cannot fork.
    """

    def __init__(self, lifeline: socket.socket) -> None:
        self._lifeline = lifeline
        self.sentinel: int | None = lifeline.fileno()
        pid = self._answer()
        if pid is None:
            raise EOFError("the fork server has ended")
        if pid < 0:
            raise OSError(-pid, os.strerror(-pid))
        self.pid = pid

    def _answer(self) -> int | None:
        try:
            data = self._lifeline.recv(ANSWER.size, socket.MSG_WAITALL)
        except ConnectionResetError:
            return None
        return None if len(data) < ANSWER.size else int(ANSWER.unpack(data)[0])

    def kill(self) -> None:
        with Ignoring(OSError):  # the fork server has ended, and it has with it
            self._lifeline.shutdown(socket.SHUT_WR)

    def exit_status(self, patience: float) -> int | None:
        poll = select.poll()
        poll.register(self._lifeline, select.POLLIN)
        if not poll.poll(1e3 * patience):
            return None
        status = self._answer()
        self.forget()
        return -signal.SIGKILL if status is None else status  # it went with its fork server

    def forget(self) -> None:
        self._lifeline.close()


class _SpawnedProcess:
    """A worker that ``multiprocessing`` has spawned."""

    sentinel: int | None = None

    def __init__(self, end: socket.socket, memory: Memory) -> None:
        context = multiprocessing.get_context("spawn")
        shared = DupFd(memory.descriptor) if memory.descriptor >= 0 else memory.tag
        arguments = (end, memory.size, shared)
        self._process = context.Process(target=_run_spawned, args=arguments, daemon=True)
        self._process.start()
        self.pid = self._process.pid or 0

    def kill(self) -> None:
        self._process.kill()

    def exit_status(self, patience: float) -> int | None:
        self._process.join(patience)
        return self._process.exitcode

    def forget(self) -> None:
        """Do nothing: ``multiprocessing`` itself forgets the processes of another process."""


def _run_spawned(end: socket.socket, size: int, shared: Any) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if isinstance(shared, str):
        memory = Memory(size, tag=shared)
    else:
        memory = Memory(size, shared.detach())
        memory.close()
    sys.exit(run_worker(end, memory))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
