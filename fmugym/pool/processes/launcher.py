"""Starts the processes of workers: with the guard, or each by itself where there is no fork."""

from __future__ import annotations

import contextlib
import functools
import marshal
import multiprocessing.spawn
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from fmugym.pool.processes import guard
from fmugym.pool.processes.shared_memory import Memory

__all__ = ["Order", "Process", "launch"]


@dataclass(frozen=True)
class Order:
    """Command to be started.

    Attributes:
        folder: Where the FMU was extracted to. It is removed if this process is killed.
        directory: The working directory.
        environment: The environment variables.
        command: A program and its arguments; empty for a worker in a bare interpreter.
        checks_heap: See ``ProcessPool``.
    """

    folder: Path
    directory: str
    environment: Mapping[str, str]
    command: Sequence[str] = ()
    checks_heap: bool = False

    def packed(self) -> bytes:
        """The order as the guard takes it."""
        parts = {
            "folder": str(self.folder),
            "directory": self.directory,
            "environment": dict(self.environment),
            "command": list(self.command),
            "path": _import_path(),
        }
        data = marshal.dumps(parts)
        return guard.SIZE.pack(len(data)) + data


def _import_path() -> list[str]:
    """Folders in which FMUs of Python look for modules, from any working directory."""
    try:
        return [os.path.abspath(place) for place in sys.path]
    except OSError:  # the working directory has been removed
        return [place for place in sys.path if os.path.isabs(place)]


class Process(Protocol):
    """A worker's process.

    Attributes:
        pid: Its number; 0 before ``confirm``.
        sentinel: A file descriptor that becomes readable when the process has ended, after
            ``confirm``; None where there is none.
    """

    pid: int
    sentinel: int | None

    def confirm(self) -> None:
        """Wait until the process is there. Many can be started before one has to be.

        Raises:
            EOFError: If the guard has ended.
            OSError: If the system refuses.
        """
        ...

    def kill(self) -> None:
        """End the process at once, whatever it does."""
        ...

    def exit_status(self, timeout: float) -> int | None:
        """Return the exit status, negative for a signal; None if it has not ended in time."""
        ...

    def forget(self) -> None:
        """Close descriptors of the process in this one, without ending it."""
        ...


def launch(end: socket.socket, memory: Memory, order: Order, pipes: Sequence[int]) -> Process:
    """Start a worker.

    Args:
        end: The worker's end of the channel. The caller may close it afterwards.
        memory: Shared with the worker.
        order: What to start.
        pipes: For its standard output and standard error; not used on Windows.

    Raises:
        OSError: If the system refuses.
    """
    if sys.platform == "win32":
        return _LoneProcess(end, order)
    descriptors = end.fileno(), memory.descriptor, *pipes
    try:
        return _guard(order.checks_heap).start(order, descriptors)
    except (EOFError, BrokenPipeError, ConnectionResetError):  # it has ended
        _guards.pop(order.checks_heap, None)
        return _guard(order.checks_heap).start(order, descriptors)


def _command(number: int) -> list[str]:
    """The command that runs the program of ``guard`` in a bare interpreter."""
    from fmugym import _native

    executable = multiprocessing.spawn.get_executable()
    if executable == sys.executable:  # nobody has set another one
        executable = getattr(sys, "_base_executable", executable)
    arguments = guard.__file__, _native.__file__, str(number), str(os.getpid())
    return [os.fsdecode(executable), "-I", "-S", *arguments]


@functools.cache
def _heap_check() -> dict[str, str]:
    """The variables by which glibc ends a process that has written beyond a block it frees."""
    try:
        maps = Path("/proc/self/maps").read_text()
    except OSError:
        return {}
    found = re.search(r"(/\S*)/libc\.so\.6$", maps, re.MULTILINE)
    checker = Path(found[1]) / "libc_malloc_debug.so.0" if found else None
    if checker is None or not checker.exists():
        return {}
    loaded = os.environ.get("LD_PRELOAD", "")
    return {"LD_PRELOAD": f"{checker} {loaded}".strip(), "MALLOC_CHECK_": "3"}


class _Guard:
    """This end of the guard; a process has at most one, and one whose workers check their heaps."""

    def __init__(self, checks_heap: bool) -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            process = subprocess.Popen(
                _command(theirs.fileno()),
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env=os.environ | (_heap_check() if checks_heap else {}),
            )
            self._requests = ours.detach()  # a socket would complain at the interpreter's end
        self.pid = process.pid
        process.returncode = 0  # or else Popen would complain that it still runs
        self._stop = weakref.finalize(self, _stop, self._requests, self.pid)
        self._stop.atexit = False  # pools may still have to close their workers then

    def start(self, order: Order, descriptors: Sequence[int]) -> _GuardedProcess:
        """Start a worker with a lifeline of its own, so that threads do not mix.

        Raises:
            EOFError: If the guard has ended.
            OSError: If the system refuses.
        """
        ours, theirs = socket.socketpair()
        try:
            with theirs, socket.socket(fileno=os.dup(self._requests)) as requests:
                socket.send_fds(requests, [b"w"], [theirs.fileno(), *descriptors])
            ours.sendall(order.packed())
            return _GuardedProcess(ours)
        except BaseException:
            ours.close()
            raise

    def forget(self) -> None:
        """Let go of the guard, because this process is a fork of the one that started it."""
        self._stop.detach()
        os.close(self._requests)


def _stop(requests: int, pid: int) -> None:
    os.close(requests)
    with contextlib.suppress(ChildProcessError):
        os.waitpid(pid, 0)


_guards: Final[dict[bool, _Guard]] = {}
"""Those of this process: whether their workers check their heaps, and the guards."""

_making = threading.Lock()


def _guard(checks_heap: bool = False) -> _Guard:
    """Return a guard of this process; several threads may ask at the same time."""
    with _making:
        if checks_heap not in _guards:
            _guards[checks_heap] = _Guard(checks_heap)
        return _guards[checks_heap]


def _forget_guards() -> None:
    while _guards:
        _guards.popitem()[1].forget()
    _making.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_making.acquire,
        after_in_parent=_making.release,
        after_in_child=_forget_guards,
    )


class _GuardedProcess:
    """A worker of the guard.

    Args:
        lifeline: Gives the process number and the exit status. It is closed with the process.
    """

    def __init__(self, lifeline: socket.socket) -> None:
        self._lifeline, self.pid = lifeline, 0
        self.sentinel: int | None = lifeline.fileno()

    def confirm(self) -> None:
        pid = self._answer()
        if pid is None:
            raise EOFError("the guard has ended")
        if pid < 0:
            raise OSError(-pid, os.strerror(-pid))
        self.pid = pid

    def _answer(self) -> int | None:
        try:
            data = self._lifeline.recv(guard.ANSWER.size, socket.MSG_WAITALL)
        except ConnectionResetError:
            return None
        return None if len(data) < guard.ANSWER.size else int(guard.ANSWER.unpack(data)[0])

    def kill(self) -> None:
        with suppress(OSError):  # the guard has ended, and it has with it
            self._lifeline.shutdown(socket.SHUT_WR)

    def exit_status(self, timeout: float) -> int | None:
        poll = select.poll()
        poll.register(self._lifeline, select.POLLIN)
        for _ in range(1 if self.pid else 2):  # before ``confirm``, the process number comes first
            if not poll.poll(1e3 * timeout):
                return None
            status = self._answer()
        self.forget()
        return -signal.SIGKILL if status is None else status  # it went with its guard

    def forget(self) -> None:
        self._lifeline.close()


class _LoneProcess:
    """A worker on Windows, which has no guard."""

    sentinel: int | None = None

    def __init__(self, end: socket.socket, order: Order) -> None:
        share = getattr(end, "share")  # noqa: B009  (mypy knows it on Windows only)
        process = subprocess.Popen(
            _command(len(share(os.getpid()))),
            stdin=subprocess.PIPE,
            env=dict(order.environment),
            cwd=order.directory,
        )
        self._process, self.pid = process, process.pid
        assert process.stdin is not None
        with process.stdin:
            process.stdin.write(share(process.pid))

    def confirm(self) -> None:
        """Do nothing: it is there."""

    def kill(self) -> None:
        self._process.kill()

    def exit_status(self, timeout: float) -> int | None:
        try:
            return self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return None

    def forget(self) -> None:
        """Do nothing: the process ends with its channel."""
