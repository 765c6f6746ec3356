"""Quantities of recordings: named values of an episode, with units and limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

__all__ = ["KINDS", "Quantities", "Quantity"]

KINDS: Final = (
    *("action", "input", "output", "parameter", "memory", "data", "setpoint", "expression"),
)
"""What a quantity may be: an action is an input that the agent writes."""


@dataclass(frozen=True)
class Quantity:
    """A value that has a name.

    Attributes:
        name: The name in the task.
        kind: One of ``KINDS``.
        unit: Its unit; "" if none is known.
        low, high: Its limits in this unit; infinite where there are none.
        holds: Whether a value holds until the next one, as that of a schedule.
        of: The quantity that this one is a set point of; "" if there is none.
    """

    name: str
    kind: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    holds: bool = False
    of: str = ""


class Quantities(NamedTuple):
    """The quantities of a task.

    Attributes:
        all: The quantities.
        read: Returns their values, in their order, of an environment between two steps. Of a
            prototype that stands for N environments, it returns arrays of shape (N,).
    """

    all: Sequence[Quantity]
    read: Callable[[Any], Sequence[Any]]
