"""Messages between the pool of processes and one of its workers, over a pair of sockets.

A message is a code of one byte, or a code and an object. The step of a trivial FMU takes a
microsecond, so the most frequent messages are bare codes. Between processes of Python, objects are
pickled: both ends trust each other, because they run the same program of the same user.
"""

from __future__ import annotations

import math
import os
import pickle
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any, Final, Protocol

from fmugym.pool.process.output import Output

__all__ = ["Channel", "Code", "Coding", "Pickled"]

_LENGTH: Final = struct.Struct("<Q")

_LOOKS: Final = 60
"""How often a process looks before it goes to sleep; all looks take about 40 us."""

_LONGEST_WAIT: Final = 1e6
"""Seconds of one wait: ``poll`` takes at most 2**31 ms."""

_AT_ONCE: Final = getattr(socket, "MSG_DONTWAIT", 0)
"""Makes a call fail instead of waiting."""

_give_way: Final = getattr(os, "sched_yield", lambda: time.sleep(0.0))


class Code:
    """The codes. Those of replies are capital letters."""

    STEP = b"s"
    """Step all instances."""
    STEP_SOME = b"k"
    """Step all instances except those in the mask."""
    REQUEST = b"r"
    """Call a method of the worker. The object is its name and arguments."""
    RELEASE = b"f"
    """Free snapshots. The object is their numbers. There is no reply."""

    FINE = b"F"
    """The step was done, and no status is worse than a warning."""
    TROUBLE = b"T"
    """The step was done, and some statuses are worse than a warning."""
    RESULT = b"R"
    """The object is what the method returned."""
    ERROR = b"E"
    """The object is what the method raised."""
    LOG = b"L"
    """The object is a message of the FMU and its level. It may come at any time."""
    FAULT = b"X"
    """The object is the exit status of the process, which ends now. Only programs tell it."""


class Coding(Protocol):
    """Turns objects into bytes and back."""

    def dumps(self, code: bytes, content: Any) -> bytes:
        """Turn the object of a message with this code into bytes."""
        ...

    def loads(self, code: bytes, data: bytearray) -> Any:
        """Turn bytes into the object of a message with this code."""
        ...


class Pickled:
    """The coding between processes of Python; see ``Coding``."""

    def dumps(self, code: bytes, content: Any) -> bytes:
        """See ``Coding.dumps``."""
        return pickle.dumps(content, pickle.HIGHEST_PROTOCOL)

    def loads(self, code: bytes, data: bytearray) -> Any:
        """See ``Coding.loads``."""
        return pickle.loads(data)


class Channel:
    """One end of the pair.

    A process that the other end's process has forked keeps the connection open. So the connection
    alone does not tell whether the other process has ended; its sentinel does.

    Args:
        end: The socket, in blocking mode.
        sentinel: A file descriptor that becomes readable when the other process has ended; None
            where there is none.
        output: What the other process prints; passed on while this one waits.
        coding: How objects are sent.
        bell: The count of messages sent, in memory that the other process watches while it waits;
            None if it does not.

    Attributes:
        end: The socket.
    """

    def __init__(
        self,
        end: socket.socket,
        sentinel: int | None = None,
        output: Output | None = None,
        coding: Coding | None = None,
        bell: memoryview | None = None,
    ) -> None:
        self.end = end
        self._bell = bell
        self._coding = Pickled() if coding is None else coding
        self._send, self._receive = end.send, end.recv
        self._descriptor, self._sentinel = end.fileno(), sentinel
        self._lock = threading.Lock()
        self._look = _poller(end.fileno())
        self._poll = _poller(end.fileno(), sentinel)
        if output is not None:
            self._poll = _listener(output, end.fileno(), sentinel)

    def send_code(self, code: bytes) -> None:
        """Send a bare code."""
        with self._lock:
            self._send(code)
            if self._bell is not None:  # not earlier, or else the other process would wait for it
                self._bell[0] += 1

    def wait(self, seconds: float | None = None) -> bool:
        """Wait until there is something to receive or the other process has ended.

        Waking a process on an idle processor takes tens of microseconds. So this one does not go
        to sleep at once, but it lets others have the processor.

        Args:
            seconds: How long to wait at most; None for ever. A wait of more than ten days may end
                early.

        Returns:
            Whether something has come, or the process has ended.
        """
        look, poll = self._look, self._poll
        for _ in range(_LOOKS):
            if look(0.0):
                return True
            _give_way()
        if seconds is None:
            return bool(poll(None))
        return bool(poll(1e3 * min(max(0.0, seconds), _LONGEST_WAIT)))

    def receive_code(self) -> bytes:
        """Receive the next code, after ``wait``.

        Returns:
            The code; nothing if the other end is closed.

        Raises:
            OSError: If the other process has ended, and left nothing to receive.
        """
        return self._receive(1, _AT_ONCE)

    def send_object(self, code: bytes, content: Any) -> None:
        """Send a code and an object; messages of several threads do not mix."""
        data = self._coding.dumps(code, content)
        with self._lock:
            self._send_all(b"".join((code, _LENGTH.pack(len(data)), data)))
            if self._bell is not None:
                self._bell[0] += 1

    def _send_all(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            try:
                view = view[self.end.send(view, _AT_ONCE) :]
            except BlockingIOError:
                if self._has_ended():
                    raise BrokenPipeError("the other process has ended") from None
                _wait_to_send(self._descriptor, self._sentinel)

    def _has_ended(self) -> bool:
        return self._sentinel is not None and bool(_poller(self._sentinel)(0.0))

    def receive_object(self, code: bytes) -> Any:
        """Receive the object that follows this code.

        Raises:
            EOFError: If the other end is gone before the whole object has come.
        """
        (length,) = _LENGTH.unpack(self._receive_exactly(_LENGTH.size))
        return self._coding.loads(code, self._receive_exactly(length))

    def _receive_exactly(self, count: int) -> bytearray:
        data = bytearray(count)
        view = memoryview(data)
        while view:
            received = self._receive_into(view)
            if not received:
                raise EOFError
            view = view[received:]
        return data

    def _receive_into(self, view: memoryview) -> int:
        has_ended = False
        while True:
            try:
                return self.end.recv_into(view, 0, _AT_ONCE)
            except BlockingIOError:
                if has_ended:  # and this attempt came after its last bytes
                    return 0
                self._poll(None)
                has_ended = self._has_ended()

    def require_open(self) -> None:
        """Make sure that this end is open: an FMU may have closed its descriptor.

        Raises:
            OSError: If it is closed.
        """
        os.fstat(self._descriptor)

    def close(self) -> None:
        """Close this end."""
        self.end.close()


def _poller(*descriptors: int | None) -> Callable[[float | None], Any]:
    """Make a function that waits until one descriptor is readable, at most for some ms."""
    known = [descriptor for descriptor in descriptors if descriptor is not None]
    if not hasattr(select, "poll"):
        return lambda ms: select.select(known, [], [], None if ms is None else 1e-3 * ms)[0]
    poll = select.poll()
    for descriptor in known:
        poll.register(descriptor, select.POLLIN)
    return poll.poll


def _listener(output: Output, *descriptors: int | None) -> Callable[[float | None], Any]:
    """Make a function as ``_poller`` does, which passes on output while it waits."""

    def wait(ms: float | None) -> bool:
        deadline = math.inf if ms is None else time.monotonic() + 1e-3 * ms
        while True:
            look = _poller(*descriptors, *output.descriptors)
            left = None if ms is None else max(0.0, 1e3 * (deadline - time.monotonic()))
            ready = {descriptor for descriptor, _ in look(left)}
            if ready.intersection(output.descriptors):
                output.pump()
            if ready.intersection(descriptors) or time.monotonic() >= deadline:
                return bool(ready.intersection(descriptors))

    return wait


def _wait_to_send(descriptor: int, sentinel: int | None) -> None:
    """Wait until something can be sent, or the other process has ended."""
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    if sentinel is not None:
        poll.register(sentinel, select.POLLIN)
    poll.poll()
