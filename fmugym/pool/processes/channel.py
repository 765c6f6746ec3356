"""Channel between the pool of processes and one of its workers; output and exit of a worker.

A message is a head of two numbers, a code and a size, and a content of this size, over a pair of
sockets. The other end is ``native/worker/frames.c``. It may send anything: no more memory is taken
than has come, and every wait has a limit.

The worker's standard output and error are pipes to the parent, which prints them; failures quote
their end. The parent empties them while it waits for the worker, and before each request, so a step
costs nothing. A worker that prints more than a pipe holds waits for its parent.
"""

from __future__ import annotations

import math
import os
import select
import signal
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final

from fmugym.errors import printable

__all__ = ["Channel", "LateError", "Output", "describe_exit", "lines_of_echo"]

_LINES: Final = 10
_LINE_LENGTH: Final = 300
_CHUNK: Final = 65536
_LAST_CHUNKS: Final = 16
"""The most chunks that a pipe holds, on any system."""

_STREAMS: Final = (1, 2)


class Output:
    """The parent's ends of the pipes of one worker.

    Args:
        quiet: Whether what comes is only kept, and not passed on to the streams of this process.

    Attributes:
        writing_ends: For the worker: standard output and standard error.
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._streams: dict[int, int] = {}  # the descriptor of this process by the reading end
        self._lines: deque[bytes] = deque(maxlen=_LINES)
        self._unfinished = dict.fromkeys(_STREAMS, b"")
        self.writing_ends: list[int] = []

    def open(self) -> None:
        """Make the pipes, but not on Windows.

        Raises:
            OSError: If the system has no descriptor left.
        """
        if sys.platform == "win32":
            return
        for stream in _STREAMS:
            reading, writing = os.pipe()
            os.set_blocking(reading, False)
            self._streams[reading] = stream
            self.writing_ends.append(writing)

    @property
    def descriptors(self) -> Sequence[int]:
        """The reading ends that are open."""
        return tuple(self._streams)

    def release_writing_ends(self) -> None:
        """Close the worker's ends in this process, once the worker has them."""
        for end in self.writing_ends:
            os.close(end)
        self.writing_ends = []

    def pump(self) -> bool:
        """Pass on received text, at most one chunk of each stream.

        Returns:
            Whether anything has come.
        """
        passed_on = [self._pass_on(reading) for reading in self.descriptors]
        return any(passed_on)

    def drain(self) -> None:
        """Pass on everything that a worker has left."""
        for _ in range(_LAST_CHUNKS):
            if not self.pump():
                break

    def _pass_on(self, reading: int) -> bool:
        stream = self._streams[reading]
        try:
            data = os.read(reading, _CHUNK)
        except BlockingIOError:
            return False
        if not data:  # the worker has closed its end
            os.close(reading)
            del self._streams[reading]
            return True
        self._note(stream, data)
        if not self._quiet:
            _write(stream, data)
        return True

    def _note(self, stream: int, data: bytes) -> None:
        *lines, rest = (self._unfinished[stream] + data).split(b"\n")
        self._unfinished[stream] = rest[-_LINE_LENGTH:]
        self._lines.extend(line[:_LINE_LENGTH] for line in lines[-_LINES:] if line.strip())

    def lines(self) -> list[str]:
        """The last lines since ``clear``."""
        unfinished = [rest for rest in self._unfinished.values() if rest.strip()]
        return [line.decode(errors="replace") for line in (*self._lines, *unfinished)]

    def clear(self) -> None:
        """Forget the text printed so far."""
        if self._lines or any(self._unfinished.values()):
            self._lines.clear()
            self._unfinished = dict.fromkeys(_STREAMS, b"")

    def close(self) -> None:
        """Close the pipes; the lines stay."""
        for end in (*self._streams, *self.writing_ends):
            os.close(end)
        self._streams, self.writing_ends = {}, []


def _write(stream: int, data: bytes) -> None:
    view = memoryview(data)
    with suppress(OSError):  # this process may have closed it
        while view:
            view = view[os.write(stream, view) :]


def describe_exit(return_code: int) -> str:
    """Describe the end of a process.

    Args:
        return_code: As ``subprocess`` and ``multiprocessing`` give it: minus the signal's number
            on Unix, an NTSTATUS above 2**31 for a fault on Windows.

    Returns:
        ``"signal SIGSEGV"``, ``"exit status 3"`` or ``"Windows error 0xc0000005"``.
    """
    if return_code >= 2**31:
        return f"Windows error {return_code:#x}"
    if return_code >= 0:
        return f"exit status {return_code}"
    try:
        return f"signal {signal.Signals(-return_code).name}"
    except ValueError:
        return f"signal {-return_code}"


def lines_of_echo(memory: bytes) -> list[str]:
    """The last messages in memory that the C extension has echoed them to."""
    echo = memory.partition(b"\0")[0].decode(errors="replace")
    return [printable(line) for line in echo.splitlines()[-_LINES:]]


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
