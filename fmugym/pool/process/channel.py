"""Messages between the pool of processes and one of its workers, over a pair of sockets.

A message is a head of two numbers, a code and a size, and a content of this size. The other end is
``native/worker/frames.c``. It may send anything: no more memory is taken than has come, and every
wait has a limit.
"""

from __future__ import annotations

import math
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from fmugym.pool.process.output import Output

__all__ = ["Channel", "LateError"]

_HEAD: Final = struct.Struct("=QQ")

_LARGEST_PIECE: Final = 2**20
"""The most bytes of a content that there is memory for before they have come."""

_LOOKS: Final = 60
"""How often a process looks before it goes to sleep; all looks take about 40 us."""

_LONGEST_WAIT: Final = 1e6
"""Seconds of one wait: ``poll`` takes at most 2**31 ms."""

_AT_ONCE: Final = getattr(socket, "MSG_DONTWAIT", 0)
"""Makes a call fail instead of waiting."""

_give_way: Final = getattr(os, "sched_yield", lambda: time.sleep(0.0))


class LateError(OSError):
    """A message could not be sent, or its rest has not come, in time."""


class Channel:
    """One end of the pair.

    A process that the other end's process has forked keeps the connection open. So the connection
    alone does not tell whether the other process has ended; its sentinel does.

    Args:
        end: The socket, in blocking mode.
        sentinel: A file descriptor that becomes readable when the other process has ended; None
            where there is none.
        output: What the other process prints; passed on while this one waits.
        bell: The count of messages sent, the only element of memory that the other process watches
            while it waits.

    Attributes:
        end: The socket.
    """

    def __init__(
        self, end: socket.socket, sentinel: int | None, output: Output, bell: memoryview
    ) -> None:
        self.end = end
        self._bell, self._rung = bell, 0
        self._bell[0] = 0
        self._send, self._receive = end.send, end.recv
        self._descriptor, self._sentinel = end.fileno(), sentinel
        self._lock = threading.Lock()
        self._look = _poller(end.fileno())
        self._poll = _listener(output, end.fileno(), sentinel)

    def send(self, code: int, content: bytes = b"", deadline: float = math.inf) -> None:
        """Send a message; messages of several threads do not mix.

        Args:
            code: The code.
            content: The content.
            deadline: Until when, in the time of ``time.monotonic``.

        Raises:
            OSError: If the other end is gone, or a ``LateError``.
        """
        with self._lock:
            self._send_all(_HEAD.pack(code, len(content)) + content, deadline)
            self._rung += 1
            self._bell[0] = self._rung  # not earlier, or else the other process would wait for it

    def _send_all(self, data: bytes, deadline: float) -> None:
        sent = self._send_some(data, deadline)
        if sent < len(data):
            view = memoryview(data)[sent:]
            while view:
                view = view[self._send_some(view, deadline) :]

    def _send_some(self, data: bytes | memoryview, deadline: float) -> int:
        while True:
            try:
                return self._send(data, _AT_ONCE)
            except BlockingIOError:
                if self._has_ended():
                    raise BrokenPipeError("the other process has ended") from None
                _wait_to_send(_time_until(deadline), self._descriptor, self._sentinel)

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

    def receive_head(self, deadline: float) -> tuple[int, int]:
        """Receive the next code, and the size of the content, after ``wait``.

        Args:
            deadline: Until when, in the time of ``time.monotonic``.

        Raises:
            OSError: If the other process has ended, and left nothing to receive.
            EOFError: If the other end is closed.
            LateError: If the whole head has not come in time.
        """
        data = self._receive(_HEAD.size, _AT_ONCE)
        if len(data) < _HEAD.size:
            if not data:
                raise EOFError
            data += self.receive_content(_HEAD.size - len(data), deadline)
        code, size = _HEAD.unpack(data)
        return code, size

    def receive_content(self, size: int, deadline: float) -> bytes:
        """Receive a content of this size.

        Raises:
            EOFError: If the other end is gone before the whole content has come.
            LateError: If it has not come in time.
        """
        data = bytearray()
        while len(data) < size:
            received = self._receive_some(min(size - len(data), _LARGEST_PIECE), deadline)
            if not received:
                raise EOFError
            data += received
        return bytes(data)

    def _receive_some(self, size: int, deadline: float) -> bytes:
        has_ended = False
        while True:
            try:
                return self._receive(size, _AT_ONCE)
            except BlockingIOError:
                if has_ended:  # and this attempt came after its last bytes
                    return b""
                self._poll(_time_until(deadline))
                has_ended = self._has_ended()

    def _has_ended(self) -> bool:
        return self._sentinel is not None and bool(_poller(self._sentinel)(0.0))

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
    known = [descriptor for descriptor in descriptors if descriptor is not None]

    def wait(ms: float | None) -> bool:
        deadline = math.inf if ms is None else time.monotonic() + 1e-3 * ms
        while True:
            look = _poller(*known, *output.descriptors)
            left = None if ms is None else max(0.0, 1e3 * (deadline - time.monotonic()))
            ready = {one if isinstance(one, int) else one[0] for one in look(left)}
            if ready.intersection(output.descriptors):
                output.pump()
            if ready.intersection(known) or time.monotonic() >= deadline:
                return bool(ready.intersection(known))

    return wait


def _time_until(deadline: float) -> float:
    """Longest wait in ms.

    Raises:
        LateError: If the time is over.
    """
    left = deadline - time.monotonic()
    if left <= 0.0:
        raise LateError("the time is over")
    return 1e3 * min(left, _LONGEST_WAIT)


def _wait_to_send(ms: float, descriptor: int, sentinel: int | None) -> None:
    """Wait until something can be sent, or the other process has ended."""
    poll = select.poll()
    poll.register(descriptor, select.POLLOUT)
    if sentinel is not None:
        poll.register(sentinel, select.POLLIN)
    poll.poll(ms)
