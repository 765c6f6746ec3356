"""How the processes of workers are started: by a fork server, or by spawning where none can be."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import multiprocessing.spawn
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import weakref
from multiprocessing.reduction import DupFd
from pathlib import Path
from typing import Any, Protocol

from fmugym.errors import FMULoadError
from fmugym.pool.process.shared_memory import Memory
from fmugym.pool.process.worker import run_worker

__all__ = ["Process", "launch"]


class Process(Protocol):
    """A worker's process."""

    pid: int

    def kill(self) -> None:
        """End it at once, whatever it does."""
        ...

    def exit_status(self) -> int | None:
        """The exit status, negative for a signal; None if it has not ended after a moment."""
        ...


def launch(end: socket.socket, memory: Memory, folder: Path) -> Process:
    """Start a worker.

    Args:
        end: Its end of the channel; it may be closed afterwards.
        memory: Shared with it.
        folder: Where its FMU was extracted to; removed should this process be killed.

    Raises:
        FMULoadError: If the system refuses.
    """
    try:
        if sys.platform == "win32":
            return _SpawnedProcess(end, memory)
        return _ForkedProcess(end, memory, folder)
    except (OSError, EOFError) as error:
        raise FMULoadError(f"no worker process can be started: {error!r}") from error


class _ForkServer:
    """This end of ``fmugym.pool.process.fork_server``, of which one process has one."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        self._requests = ours.detach()  # a socket would complain at the interpreter's end
        program = (
            f"import sys; sys.path[:] = {sys.path!r}; "
            "from fmugym.pool.process.fork_server import main; "
            f"main({theirs.fileno()}, {os.getpid()})"
        )
        with theirs:
            process = subprocess.Popen(
                [multiprocessing.spawn.get_executable(), "-c", program],
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                # A process that forks should have no threads.
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
            )
        self.pid = process.pid
        process.returncode = 0  # for Popen, it may outlive this object
        self._stop = weakref.finalize(self, _stop, self._requests, self.pid)
        self._stop.atexit = False  # pools may still want to end their workers in order then

    def request(self, *request: Any, descriptors: tuple[int, ...] = ()) -> Any:
        """Ask for something; each reply has a socket of its own, so that threads do not mix.

        Raises:
            EOFError: If the server has ended.
        """
        ours, theirs = socket.socketpair()
        with ours:
            with theirs:
                data, given = pickle.dumps(request), [theirs.fileno(), *descriptors]
                with socket.socket(fileno=os.dup(self._requests)) as requests:
                    socket.send_fds(requests, [data], given)
            return pickle.loads(ours.recv(4096))

    def forget(self) -> None:
        """Let go of the server: this process is a fork of the one that it belongs to."""
        self._stop.detach()
        os.close(self._requests)


def _stop(requests: int, pid: int) -> None:
    os.close(requests)
    with contextlib.suppress(ChildProcessError):
        os.waitpid(pid, 0)


@functools.cache
def _fork_server() -> _ForkServer:
    return _ForkServer()


def _request(*request: Any, descriptors: tuple[int, ...] = ()) -> Any:
    """Ask the fork server, or a new one if somebody has ended it."""
    try:
        return _fork_server().request(*request, descriptors=descriptors)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        _fork_server.cache_clear()
        return _fork_server().request(*request, descriptors=descriptors)


def _forget_fork_server() -> None:
    if _fork_server.cache_info().currsize:
        _fork_server().forget()
        _fork_server.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_fork_server)


class _ForkedProcess:
    def __init__(self, end: socket.socket, memory: Memory, folder: Path) -> None:
        descriptors = (end.fileno(), memory.descriptor)
        self.pid: int = _request("start", str(folder), memory.size, descriptors=descriptors)

    def kill(self) -> None:
        try:
            os.kill(self.pid, signal.SIGKILL)
        except ProcessLookupError:  # it went with its fork server
            return

    def exit_status(self) -> int | None:
        try:
            status: int | None = _request("wait", self.pid)
        except (OSError, EOFError):  # it went with its fork server
            return -signal.SIGKILL
        return status


class _SpawnedProcess:
    def __init__(self, end: socket.socket, memory: Memory) -> None:
        context = multiprocessing.get_context("spawn")
        shared = DupFd(memory.descriptor) if memory.descriptor >= 0 else memory.tag
        arguments = (end, memory.size, shared)
        self._process = context.Process(target=_run_spawned, args=arguments, daemon=True)
        self._process.start()
        self.pid = self._process.pid or 0

    def kill(self) -> None:
        self._process.kill()

    def exit_status(self) -> int | None:
        self._process.join(0.05)
        return self._process.exitcode


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
