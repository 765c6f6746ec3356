"""Output and exit of a worker: the parent prints the output, and failures quote its end.

The worker's standard output and error are pipes to the parent. The parent empties them while it
waits for the worker, and before each request, so a step costs nothing. A worker that prints more
than a pipe holds waits for its parent.
"""

from __future__ import annotations

import os
import signal
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from fmugym.errors import printable

__all__ = ["Output", "describe_exit", "lines_of_echo"]

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
