"""Messages between the pool of processes and one of its workers, over a pair of sockets.

A message is one byte, its code, or a code and a pickled object. The step of a trivial FMU takes a
microsecond, so that the most frequent messages are bare codes. Both ends trust each other: they run
the same program of the same user.
"""

from __future__ import annotations

import os
import pickle
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any, Final

__all__ = ["Channel", "Code"]

_LENGTH: Final = struct.Struct("<Q")

_LOOKS: Final = 60
"""Before a process goes to sleep: together they take some 40 us."""

_give_way: Final = getattr(os, "sched_yield", lambda: time.sleep(0.0))


class Code:
    """The codes; those of replies have capital letters."""

    STEP = b"s"
    """Step all instances."""
    STEP_SOME = b"k"
    """Step all instances but those in the mask."""
    REQUEST = b"r"
    """Call a method of the worker; with its name and arguments."""
    RELEASE = b"f"
    """Free snapshots; with their numbers. There is no reply."""

    FINE = b"F"
    """The step was done, and no status is worse than a warning."""
    TROUBLE = b"T"
    """The step was done, and the statuses tell what is wrong."""
    RESULT = b"R"
    """With what the method returned."""
    ERROR = b"E"
    """With what it raised."""
    LOG = b"L"
    """A message of the FMU, with its level; comes at any time."""


class Channel:
    """One end of the pair.

    Args:
        end: The socket, in blocking mode.

    Attributes:
        end: The socket.
    """

    def __init__(self, end: socket.socket) -> None:
        self.end = end
        self._send, self._receive = end.send, end.recv
        self._descriptor = end.fileno()
        self._lock = threading.Lock()
        self._poll = _poller(end)

    def send_code(self, code: bytes) -> None:
        """Send a bare code."""
        with self._lock:
            self._send(code)

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until there is something to receive, at most for some seconds.

        To wake a process on an idle processor takes tens of microseconds, so that it does not go
        to sleep at once; but it lets others have the processor.
        """
        poll = self._poll
        for _ in range(_LOOKS):
            if poll(0.0):
                return True
            _give_way()
        return bool(poll(None if seconds is None else max(0.0, 1e3 * seconds)))

    def receive_code(self) -> bytes:
        """Receive the next code; nothing if the other end is gone."""
        return self._receive(1)

    def send_object(self, code: bytes, content: Any) -> None:
        """Send a code and an object; what several threads send does not mix."""
        data = pickle.dumps(content, pickle.HIGHEST_PROTOCOL)
        with self._lock:
            self.end.sendall(b"".join((code, _LENGTH.pack(len(data)), data)))

    def receive_object(self) -> Any:
        """Receive the object that follows a code.

        Raises:
            EOFError: If the other end is gone before all of it has come.
        """
        (length,) = _LENGTH.unpack(self._receive_exactly(_LENGTH.size))
        return pickle.loads(self._receive_exactly(length))

    def _receive_exactly(self, count: int) -> bytearray:
        data = bytearray(count)
        view = memoryview(data)
        while view:
            received = self.end.recv_into(view)
            if not received:
                raise EOFError
            view = view[received:]
        return data

    def require_open(self) -> None:
        """Make sure that nobody has closed this end behind our back, as an FMU may.

        Raises:
            OSError: If somebody has.
        """
        os.fstat(self._descriptor)

    def close(self) -> None:
        """Close this end."""
        self.end.close()


def _poller(end: socket.socket) -> Callable[[float | None], Any]:
    """A function that waits for something to read, at most for some ms."""
    if not hasattr(select, "poll"):
        return lambda ms: select.select([end], [], [], None if ms is None else 1e-3 * ms)[0]
    poll = select.poll()
    poll.register(end, select.POLLIN)
    return poll.poll
