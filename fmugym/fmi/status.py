"""What FMI calls return, and where an instance is in FMI's state machine."""

from __future__ import annotations

import enum

__all__ = ["Phase", "Status", "sane"]


class Status(enum.IntEnum):
    """What a call returned: FMI's own codes, and two of ours."""

    OK = 0
    WARNING = 1
    DISCARD = 2
    ERROR = 3
    FATAL = 4
    TERMINATED = 6
    """The FMU asked to stop; its outputs are valid."""
    NOT_FINITE = 7
    """An output is NaN or infinite."""


class Phase(enum.Enum):
    """Where an instance is in FMI's state machine, as far as it decides which call is legal."""

    INSTANTIATED = enum.auto()
    STEPPING = enum.auto()
    ENDED = enum.auto()
    """After a step that was not done: reading and a reset are legal."""
    FAILED = enum.auto()
    """After Error: a reset is legal."""
    DEAD = enum.auto()
    """After Fatal or free: no call is legal."""


def sane(status: int) -> int:
    """Pending is an error, since no asynchronous step was asked for, and so is any other code."""
    return status if 0 <= status <= Status.FATAL else Status.ERROR
