"""Why a process died, and what it said last."""

from __future__ import annotations

import signal
import threading
from collections import deque
from typing import BinaryIO, Final

from fmugym.errors import printable

__all__ = ["OutputTail", "describe_exit", "lines_of_echo"]

_LINES: Final = 10
_LINE_LENGTH: Final = 300


def describe_exit(return_code: int) -> str:
    """Say how a process ended.

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


class OutputTail:
    """Reads a pipe to its end on a thread, and keeps only the last lines.

    Args:
        pipe: The reading end. It is closed when everything has been read.
    """

    def __init__(self, pipe: BinaryIO) -> None:
        self._pipe = pipe
        self._lines: deque[bytes] = deque(maxlen=_LINES)
        self._thread = threading.Thread(target=self._read, name="fmugym-output", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with self._pipe:
            # A line without an end comes in pieces of this length.
            for line in iter(lambda: self._pipe.readline(_LINE_LENGTH), b""):
                if line.strip():
                    self._lines.append(line)

    def lines(self, timeout: float = 1.0) -> list[str]:
        """The last lines, made printable, once the pipe has ended.

        Args:
            timeout: Seconds to wait for the end. A process that the dead one has started may keep
                the pipe open.
        """
        self._thread.join(timeout)
        return [printable(line.decode(errors="replace").strip()) for line in tuple(self._lines)]
