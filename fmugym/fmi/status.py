"""Status codes of FMI calls."""

from __future__ import annotations

import enum
from typing import Final

__all__ = ["TERMINATED_CODE", "WARNING_CODE", "Status", "failed_call", "sane"]


class Status(enum.IntEnum):
    """The status of a call: FMI's codes, and two more."""

    OK = 0
    WARNING = 1
    DISCARD = 2
    ERROR = 3
    FATAL = 4
    TERMINATED = 6
    """The FMU asked to stop; its outputs are valid."""
    NOT_FINITE = 7
    """An output is NaN or infinite."""


WARNING_CODE: Final = int(Status.WARNING)
TERMINATED_CODE: Final = int(Status.TERMINATED)
"""Statuses for comparisons with arrays, as numbers: numpy is slow with members of enumerations."""


def sane(status: int) -> int:
    """Turn codes that no call here may return into an error, Pending included."""
    return status if 0 <= status <= Status.FATAL else Status.ERROR


def failed_call(doing: str, status: int, where: str) -> str:
    """Describe the status of a failed call.

    Args:
        doing: The call.
        status: A ``Status``.
        where: The component of a system; "" for a lone FMU.
    """
    known = Status(status)
    result = "failed" if known is Status.NOT_FINITE else f"returned {known.name.capitalize()}"
    return f"{doing} {result}" + (f" in {where}" if where else "")
