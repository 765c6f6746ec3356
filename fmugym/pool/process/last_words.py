"""Why a process died, and what it said last."""

from __future__ import annotations

import signal
from typing import Final

from fmugym.errors import printable

__all__ = ["describe_exit", "lines_of_echo"]

_LINES: Final = 10


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
