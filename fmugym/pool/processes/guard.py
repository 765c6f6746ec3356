"""Starts workers, and ends them with the process that uses them.

This file is a program for a bare interpreter: it imports nothing but the C extension and parts of
the standard library, so that it starts within milliseconds. It has an interpreter of its own,
because a fork of the user's process would copy the locks of its threads. It ends as soon as its
parent does, whatever the reason. Then it ends the workers and removes their folders.

Each request comes with five descriptors: a socket, the worker's lifeline; the worker's end of its
channel; the shared memory; and two pipes for what it prints. The rest of the request comes through
the lifeline. The guard answers there with the worker's process number, and with its exit status
when it has ended. The parent shuts the lifeline down to have the worker killed. An FMU may fork;
each worker leads a process group of its own, and what is left of the group is killed with the
worker.

Windows has no fork: there each worker is a process of this program that has no guard.
"""

from __future__ import annotations

import contextlib
import importlib.machinery
import importlib.util
import marshal
import os
import signal
import socket
import struct
import sys
import time
from collections.abc import Sequence
from typing import Any, Final, NoReturn

if sys.platform != "win32":
    import select

__all__ = ["ANSWER", "LONGEST_START", "SIZE", "serve_parent"]

ANSWER: Final = struct.Struct("<q")
"""First the process number or minus an error number, then the exit status, negative for signals."""

SIZE: Final = struct.Struct("<q")
"""The size of the rest of a request: that of its marshalled order."""

LONGEST_START: Final = 10.0
"""How long Wine may take until its server knows a worker, in s. If the worker is killed before, the
server stays for ever. A worker whose channel is closed ends by itself."""

_DESCRIPTORS: Final = 5
_MOST_DESCRIPTORS: Final = 4096
_IGNORED_SIGNALS: Final = ("SIGINT", "SIGTERM", "SIGHUP", "SIGTTIN", "SIGTTOU")
"""The first are meant for the parent, and often sent to all of its processes. The last two would
stop a process in the background that uses the terminal."""

_STREAMS: Final = (1, 2)

_LOOK: Final = 100
"""How long to wait before another look at the time, in ms."""


def serve_parent(extension: str, descriptor: int, parent: int) -> NoReturn:
    """Serve the parent until it ends.

    Args:
        extension: The file of the C extension.
        descriptor: The file descriptor of the socket from which requests come.
        parent: The parent's process number.
    """
    for name in _IGNORED_SIGNALS:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    guard = _Guard(_load(extension), socket.socket(fileno=descriptor), parent)
    try:
        guard.serve()
    finally:
        guard.clean_up()
        os._exit(0)


def _load(path: str) -> Any:
    """Load the C extension without its package."""
    loader = importlib.machinery.ExtensionFileLoader("fmugym._native", path)
    spec = importlib.util.spec_from_loader("fmugym._native", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


class _Worker:
    def __init__(self, pid: int, lifeline: socket.socket, longest_start: float) -> None:
        self.pid, self.lifeline = pid, lifeline
        self._starts_until = time.monotonic() + longest_start

    def may_be_starting(self) -> bool:
        """Whether Wine may still be on its way to the program."""
        return time.monotonic() < self._starts_until

    def kill(self) -> None:
        _kill_group(self.pid)
        os.kill(self.pid, signal.SIGKILL)  # a new process leads no group yet


class _Guard:
    def __init__(self, native: Any, requests: socket.socket, parent: int) -> None:
        self._native, self._requests = native, requests
        self._workers: dict[int, _Worker] = {}  # by the descriptor of the lifeline
        self._folders: set[str] = set()
        self._ended, self._wakeup = os.pipe()
        for end in (self._ended, self._wakeup):
            os.set_blocking(end, False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(self._wakeup, warn_on_full_buffer=False)
        self._poll = select.poll()
        self._parent = -1
        if hasattr(os, "pidfd_open"):  # a fork of the parent may keep the socket open
            self._parent = os.pidfd_open(parent)
            self._poll.register(self._parent, select.POLLIN)
        self._poll.register(requests, select.POLLIN)
        self._poll.register(self._ended, select.POLLIN)

    def serve(self) -> None:
        """Answer requests until the parent ends."""
        while True:
            # One event at a time: what comes next may concern a descriptor that this one closes.
            descriptor, _ = self._poll.poll()[0]
            if descriptor == self._ended:
                self._bury()
            elif descriptor in self._workers:
                self._kill(descriptor)
            elif descriptor == self._parent or not self._answer():
                return

    def _answer(self) -> bool:
        """Answer a request; returns whether there was one."""
        data, descriptors, _, _ = socket.recv_fds(self._requests, 1, _DESCRIPTORS)
        if not data:
            return False
        if len(descriptors) < _DESCRIPTORS:
            # none are left: the parent finds that the lifeline is cut
            for descriptor in descriptors:
                os.close(descriptor)
            return True
        lifeline = socket.socket(fileno=descriptors[0])
        order = _received(lifeline)
        if order is None:
            lifeline.close()
        else:
            self._start(lifeline, order, descriptors[1:])
        for descriptor in descriptors[1:]:
            os.close(descriptor)
        return True

    def _start(self, lifeline: socket.socket, order: Any, descriptors: Sequence[int]) -> None:
        """Fork a worker and send its process number."""
        guard = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            pid = -(error.errno or 1)
        if pid == 0:
            lifeline.close()
            self._become_worker(guard, order, *descriptors)
        _send(lifeline, pid)
        if pid < 0:
            lifeline.close()
            return
        longest_start = LONGEST_START if order["command"] else 0.0
        self._workers[lifeline.fileno()] = _Worker(pid, lifeline, longest_start)
        self._folders = {order["folder"], *filter(os.path.isdir, self._folders)}
        self._poll.register(lifeline, select.POLLIN)

    def _become_worker(
        self, guard: int, order: Any, channel: int, memory: int, output: int, error: int
    ) -> NoReturn:
        status = 1
        try:
            self._let_go()
            for descriptor, stream in zip((output, error), _STREAMS, strict=True):
                os.dup2(descriptor, stream)
                os.close(descriptor)
            os.setpgid(0, 0)  # not a session: Linux schedules each by itself
            os.chdir(order["directory"])
            if self._native.end_with(guard):
                if order["command"]:
                    _become_program(order, channel)
                os.environ.clear()
                os.environ.update(order["environment"])
                sys.path[:] = order["path"]
                self._native.serve(channel, memory)
                status = 0
        finally:
            os._exit(status)

    def _let_go(self) -> None:
        """Close descriptors of the guard in a fork of it."""
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        self._requests.close()
        for worker in self._workers.values():
            worker.lifeline.close()
        for descriptor in (self._ended, self._wakeup, self._parent):
            if descriptor >= 0:
                os.close(descriptor)

    def _kill(self, descriptor: int) -> None:
        """Kill a worker that the parent has given up; its end is reported like any other."""
        self._poll.unregister(descriptor)
        worker = self._workers[descriptor]
        if not (worker.may_be_starting() and self._parent_ends()):
            worker.kill()

    def _parent_ends(self) -> bool:
        """Whether the parent ends right now: its lifelines are cut a moment before."""
        if self._parent < 0:
            return False
        poll = select.poll()
        poll.register(self._parent, select.POLLIN)
        return bool(poll.poll(_LOOK))

    def _bury(self) -> None:
        """Report the exit status of each worker that has ended.

        An FMU may have made the guard its tracer. Then a signal stops it until the guard lets go.
        """
        with contextlib.suppress(BlockingIOError):
            os.read(self._ended, 4096)
        with contextlib.suppress(ChildProcessError):
            while (changed := os.waitpid(-1, os.WNOHANG)) != (0, 0):
                pid, status = changed
                if os.WIFSTOPPED(status):
                    self._native.stop_tracing(pid, os.WSTOPSIG(status))
                else:
                    self._tell_end(pid, status)

    def _tell_end(self, pid: int, status: int) -> None:
        _kill_group(pid)
        for descriptor, worker in list(self._workers.items()):
            if worker.pid == pid:
                del self._workers[descriptor]
                with contextlib.suppress(KeyError):
                    self._poll.unregister(descriptor)
                _send(worker.lifeline, os.waitstatus_to_exitcode(status))
                worker.lifeline.close()

    def clean_up(self) -> None:
        """End all workers and remove their folders."""
        ended = select.poll()
        ended.register(self._ended, select.POLLIN)
        while self._kill_those_that_run():
            ended.poll(_LOOK)
            self._bury()
        for folder in self._folders:
            _remove(folder)

    def _kill_those_that_run(self) -> bool:
        """Returns whether there are others."""
        starting = [worker.may_be_starting() for worker in self._workers.values()]
        for worker, is_starting in zip(self._workers.values(), starting, strict=True):
            if not is_starting:
                worker.kill()
        return any(starting)


def _received(lifeline: socket.socket) -> Any:
    """Receive the order of a worker; None if the parent has ended."""
    head = lifeline.recv(SIZE.size, socket.MSG_WAITALL)
    if len(head) < SIZE.size:
        return None
    (size,) = SIZE.unpack(head)
    data = lifeline.recv(size, socket.MSG_WAITALL)
    return marshal.loads(data) if len(data) == size else None


def _become_program(order: Any, channel: int) -> NoReturn:
    """Replace this process; the channel becomes its standard input and output."""
    os.dup2(channel, 0)
    os.dup2(channel, 1)
    os.closerange(3, _MOST_DESCRIPTORS)
    os.execve(order["command"][0], order["command"], order["environment"])


def _kill_group(leader: int) -> None:
    """Kill the rest of a worker's process group."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # nothing is left
        os.killpg(leader, signal.SIGKILL)


def _send(lifeline: socket.socket, answer: int) -> None:
    with contextlib.suppress(OSError):  # the parent may have closed it
        lifeline.sendall(ANSWER.pack(answer))


def _remove(folder: str) -> None:
    """Remove a folder; ``shutil`` would take as long to import as all the rest."""
    for place, folders, files in os.walk(folder, topdown=False):
        for name in (*files, *folders):
            path = os.path.join(place, name)
            with contextlib.suppress(OSError):
                (os.rmdir if os.path.isdir(path) and not os.path.islink(path) else os.unlink)(path)
    with contextlib.suppress(OSError):
        os.rmdir(folder)


def serve_alone(extension: str, size: int, parent: int) -> None:
    """Be a worker without a guard, on Windows.

    Args:
        extension: The file of the C extension.
        size: The size of the shared socket, which comes on the standard input.
        parent: The parent's process number.
    """
    native, share = _load(extension), sys.stdin.buffer.read(size)
    end = socket.fromshare(share)  # type: ignore[attr-defined, unused-ignore]
    if native.end_with(parent):
        native.serve(end.detach(), -1)


if __name__ == "__main__":
    (serve_alone if sys.platform == "win32" else serve_parent)(
        sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    )
