"""The start to which components of a system return.

``native/system_reset.c`` does the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from fmugym.fmi.instance import SavedState
from fmugym.systems.description import PartVariable

__all__ = ["KeptStart", "Key"]

Key = tuple[float, tuple[tuple[PartVariable, str], ...]]
"""The start time, and what is set before the initialization."""


@dataclass
class KeptStart:
    """What is known of the last initialization of a system.

    Attributes:
        states: Those of the components that restore, by their numbers.
        slots: The inputs and outputs of all components, as bytes.
        key: What was set before it.
        known: Whether the states are there.
        stepped: Whether there were steps since.
        useless: The components for which restoring did not work.
    """

    states: dict[int, SavedState] = field(default_factory=dict)
    slots: tuple[bytes, bytes] = b"", b""
    key: Key | None = None
    known: bool = False
    stepped: bool = False
    useless: set[int] = field(default_factory=set)

    @staticmethod
    def key_of(start_time: float, values: list[tuple[PartVariable, Any]]) -> Key:
        """What stands for everything that is set; equal numbers may differ in their sign."""
        return start_time, tuple((end, repr(value)) for end, value in values)

    def next(self, key: Key) -> bool:
        """Go on to another initialization; returns whether its states are worth keeping."""
        again = self.stepped and key == self.key
        self.key, self.stepped = key, False
        return again

    def forget(self) -> None:
        """Release the states."""
        self.known = False
        for state in self.states.values():
            state.release()
        self.states.clear()
