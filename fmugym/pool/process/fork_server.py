"""A process that has everything imported and forks a worker within milliseconds.

It is started with an interpreter of its own: a fork of the user's process would copy its threads'
locks, and a worker should not run the user's program again, as those of ``multiprocessing`` do. It
ends as soon as its parent does, however that may come about, ends the workers and removes the
folders they worked in.
"""

from __future__ import annotations

import ctypes
import gc
import os
import pickle
import select
import shutil
import signal
import socket
import sys
import time
from typing import Any, Final, NoReturn

from fmugym.pool.process.shared_memory import Memory
from fmugym.pool.process.worker import run_worker

__all__ = ["LARGEST_REQUEST", "main"]

LARGEST_REQUEST: Final = 65536
"""In bytes; it is sent and received as a whole."""

_PR_SET_PDEATHSIG: Final = 1
_PATIENCE: Final = 0.05
"""How long a worker that has closed its channel may take to end, in seconds."""


def main(descriptor: int, parent: int) -> NoReturn:
    """Serve the parent until it ends.

    Args:
        descriptor: Of the socket from which requests come. Each comes with a socket for its reply.
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


class _Server:
    def __init__(self, requests: socket.socket, parent: int) -> None:
        self._requests = requests
        self._folders: dict[int, str] = {}  # by worker
        self._poll = select.poll()
        self._poll.register(requests, select.POLLIN)
        self._parent = -1
        if hasattr(os, "pidfd_open"):  # a fork of the parent may keep the socket open
            self._parent = os.pidfd_open(parent)
            self._poll.register(self._parent, select.POLLIN)

    def serve(self) -> None:
        while all(which != self._parent for which, _ in self._poll.poll()):
            data, descriptors, _, _ = socket.recv_fds(self._requests, LARGEST_REQUEST, 3)
            if not data:
                return
            self._answer(pickle.loads(data), descriptors)

    def _answer(self, request: tuple[str, Any, Any], descriptors: list[int]) -> None:
        name, *arguments = request
        with socket.socket(fileno=descriptors.pop(0)) as replies:
            if name == "start":
                result: int | None = self._start(replies, *arguments, *descriptors)
            else:
                result = self._wait(*arguments)
            replies.sendall(pickle.dumps(result))

    def _start(
        self, replies: socket.socket, folder: str, size: int, channel: int, memory: int
    ) -> int:
        """Fork a worker; returns its process number."""
        server = os.getpid()
        worker = os.fork()
        if worker == 0:
            replies.close()
            self._become_worker(server, channel, Memory(size, memory))
        os.close(channel)
        os.close(memory)
        self._folders[worker] = folder
        return worker

    def _become_worker(self, server: int, channel: int, memory: Memory) -> NoReturn:
        status = 1
        try:
            self._requests.close()
            if self._parent >= 0:
                os.close(self._parent)
            memory.close()
            if _end_with_parent(server):
                status = run_worker(socket.socket(fileno=channel), memory)
        finally:
            os._exit(status)

    def _wait(self, worker: int) -> int | None:
        """The exit status of a worker, negative for a signal, or None if it goes on."""
        if worker not in self._folders:  # it went with the server before this one
            return -signal.SIGKILL
        deadline = time.monotonic() + _PATIENCE
        while (ended := os.waitpid(worker, os.WNOHANG)) == (0, 0):
            if time.monotonic() > deadline:
                return None
            time.sleep(1e-3)
        del self._folders[worker]
        return os.waitstatus_to_exitcode(ended[1])

    def clean_up(self) -> None:
        """End all workers and remove what they leave."""
        for worker in self._folders:
            os.kill(worker, signal.SIGKILL)
        for folder in set(self._folders.values()):
            shutil.rmtree(folder, ignore_errors=True)


def _end_with_parent(parent: int) -> bool:
    """Let the system end this process with its parent; returns whether that still lives."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent
