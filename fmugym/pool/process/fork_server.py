"""A process that has everything imported and forks a worker within milliseconds.

It has an interpreter of its own. A fork of the user's process would copy the locks of its threads,
and a spawned worker of ``multiprocessing`` would run the user's program again. The server ends as
soon as its parent does, whatever the reason. Then it ends the workers and removes their folders.

Each request comes with a socket, the worker's lifeline. The server answers through it with the
worker's process number, and with its exit status when it has ended. The parent shuts the lifeline
down to have the worker killed. An FMU may fork; each worker leads a process group of its own, and
what is left of the group is killed with the worker.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import pickle
import select
import shutil
import signal
import socket
import struct
import sys
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, NoReturn

from fmugym.pool.process.output import redirect
from fmugym.pool.process.shared_memory import Memory
from fmugym.pool.process.worker import run_worker
from fmugym.signals import Ignoring, ordinary

__all__ = ["ANSWER", "LARGEST_REQUEST", "PROGRAM", "Program", "main"]

LARGEST_REQUEST: Final = 65536
"""In bytes. A request is sent and received as a whole."""

ANSWER: Final = struct.Struct("<q")
"""First the process number or minus an error number, then the exit status, negative for signals."""

PROGRAM: Final = -1
"""In the place of the size of the memory: the worker is a program, and the descriptor of the memory
that of a file with the pickled ``Program``."""

_PR_SET_PDEATHSIG: Final = 1
_MOST_DESCRIPTORS: Final = 4096
_DESCRIPTORS: Final = 5
"""The descriptors of a request: the lifeline, the channel, the memory, and two pipes for what the
worker prints."""


def main(descriptor: int, parent: int) -> NoReturn:
    """Serve the parent until it ends.

    Args:
        descriptor: The file descriptor of the socket from which requests come.
        parent: The parent's process number.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    gc.collect()
    gc.freeze()  # or else the collector would write to the pages that the workers share
    server = _Server(socket.socket(fileno=descriptor), parent)
    try:
        server.serve()
    finally:
        server.clean_up()
        os._exit(0)


def _kill_group(leader: int) -> None:
    """Kill what is left of a worker's process group."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # nothing is left
        os.killpg(leader, signal.SIGKILL)


class Program(NamedTuple):
    """A program to start, with its arguments, environment variables and working directory."""

    command: Sequence[str]
    environment: Mapping[str, str]
    directory: str

    def become(self, channel: int) -> NoReturn:
        """Replace this process; the channel becomes its standard input and output."""
        os.dup2(channel, 0)
        os.dup2(channel, 1)
        os.closerange(3, _MOST_DESCRIPTORS)
        with Ignoring(OSError):  # it may have been removed
            os.chdir(self.directory)
        os.execve(self.command[0], list(self.command), self.environment)


class _Worker(NamedTuple):
    pid: int
    lifeline: socket.socket

    def kill(self) -> None:
        _kill_group(self.pid)
        os.kill(self.pid, signal.SIGKILL)  # a new process leads no group yet


class _Server:
    def __init__(self, requests: socket.socket, parent: int) -> None:
        self._requests = requests
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
        data, descriptors, _, _ = socket.recv_fds(self._requests, LARGEST_REQUEST, _DESCRIPTORS)
        if not data:
            return False
        if len(descriptors) == _DESCRIPTORS:
            self._start(*pickle.loads(data), *descriptors)
        else:  # no descriptors are left: the parent finds that the lifeline is cut
            for descriptor in descriptors:
                os.close(descriptor)
        return True

    def _start(
        self, folder: str, size: int, lifeline: int, channel: int, memory: int, *pipes: int
    ) -> None:
        """Fork a worker and send its process number."""
        answers = socket.socket(fileno=lifeline)
        server = os.getpid()
        try:
            pid = os.fork()
        except ordinary(OSError) as error:
            pid = -(error.errno or 1)
        if pid == 0:
            answers.close()
            if size == PROGRAM:
                self._become_program(server, channel, memory, pipes)
            self._become_worker(server, channel, Memory(size, memory), pipes)
        for descriptor in (channel, memory, *pipes):
            os.close(descriptor)
        _send(answers, pid)
        if pid < 0:
            answers.close()
            return
        self._workers[lifeline] = _Worker(pid, answers)
        self._folders = {folder, *filter(os.path.isdir, self._folders)}
        self._poll.register(lifeline, select.POLLIN)

    def _become_worker(
        self, server: int, channel: int, memory: Memory, pipes: Sequence[int]
    ) -> NoReturn:
        status = 1
        try:
            self._let_go()
            memory.close()
            redirect(*pipes)
            os.setpgid(0, 0)  # not a session: Linux schedules each by itself
            if _end_with_parent(server):
                status = run_worker(socket.socket(fileno=channel), memory)
                ctypes.CDLL(None).fflush(None)  # a line without an end
        finally:
            os._exit(status)

    def _become_program(
        self, server: int, channel: int, order: int, pipes: Sequence[int]
    ) -> NoReturn:
        try:
            self._let_go()
            program = pickle.loads(os.pread(order, os.fstat(order).st_size, 0))
            redirect(*pipes)
            os.setpgid(0, 0)
            if _end_with_parent(server):
                program.become(channel)
        finally:
            os._exit(1)

    def _let_go(self) -> None:
        """Close what belongs to the server, as a fork of it."""
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
        self._workers[descriptor].kill()

    def _bury(self) -> None:
        """Report the exit status of each worker that has ended."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._ended, 4096)
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG)) != (0, 0):
                self._tell_end(*ended)

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
        for worker in self._workers.values():
            worker.kill()
        for folder in self._folders:
            shutil.rmtree(folder, ignore_errors=True)


def _send(lifeline: socket.socket, answer: int) -> None:
    with Ignoring(OSError):  # the parent may have closed it
        lifeline.sendall(ANSWER.pack(answer))


def _end_with_parent(parent: int) -> bool:
    """Let the system end this process with its parent; returns whether the parent still lives."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent
