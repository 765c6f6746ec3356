"""Sessions on cells, and leases of cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from fmugym.checks import check_number
from fmugym.errors import shown
from fmugym.lab.cell import Cell
from fmugym.lab.data import LabError, as_lab_error

__all__ = ["Gym", "Session", "entries_of"]

_SensorQuantity = Literal["position", "velocity", "torque"]


@dataclass(eq=False)
class Gym:
    """A lease of several cells.

    Attributes:
        token: The gym token.
        cells: The leased cells.
        ends: When the lease ends, in s of the lab's time.
        ended: Why it has ended, or None.
        is_stopped: Whether the user has stopped it.
    """

    token: str
    cells: list[Cell]
    ends: float
    ended: str | None = None
    is_stopped: bool = False
    kind: ClassVar[str] = "gym"

    def bring_to(self, now: float) -> None:
        """End the lease if its time is over; ``now`` is the lab's time in s."""
        if now >= self.ends:
            self.end("its time is over")

    def end(self, reason: str) -> None:
        """End the lease; does nothing if it has ended."""
        self.ended = self.ended or f"the gym has ended: {reason}"


@dataclass(eq=False)
class Session:
    """One use of one cell: an experiment or an episode.

    Attributes:
        token: The session or episode token.
        cell: The cell.
        began: When it began, in s of the lab's time.
        length: Length in s.
        gym: The lease of an episode, or None.
        ended: Why it has ended, or None.
        is_stopped: Whether the user has stopped it.
    """

    token: str
    cell: Cell
    began: float
    length: float
    gym: Gym | None
    ended: str | None = None
    is_stopped: bool = False

    def __post_init__(self) -> None:
        self._last_request = self.began

    @property
    def kind(self) -> str:
        """The name that error texts use."""
        return "experiment" if self.gym is None else "episode"

    def request(self, now: float) -> None:
        """Bring the cell to the present for a request, which counts as a heartbeat.

        Args:
            now: The lab's time, in s.

        Raises:
            LabError: If the session has ended.
        """
        self.bring_to(now)
        if self.ended is not None:
            raise LabError(self.ended)
        self._last_request = now

    def bring_to(self, now: float) -> None:
        """Bring the cell to the present, and end the session if it should have ended by then.

        Args:
            now: The lab's time, in s.
        """
        if self.ended is not None:
            return
        deadline, reason = self._deadline()
        self.cell.advance(min(now, deadline) - self.began)
        if self.cell.fault is not None:
            self._end(self.cell.fault)
        elif now >= deadline:
            self.end(reason)

    def end(self, reason: str) -> None:
        """Bring the cell to rest and free it; does nothing if the session has ended.

        Args:
            reason: The reason that later requests get.
        """
        self._end(f"the {self.kind} has ended: {reason}")

    def _end(self, text: str) -> None:
        if self.ended is None:
            self.ended = text
            self.cell.park()

    def read(self, quantity: _SensorQuantity) -> float | list[float]:
        """Return the newest reading: a float for one actuator, a list for two."""
        values = self.cell.sensors.sample[quantity]
        return values[0] if len(values) == 1 else list(values)

    def command(self, quantity: _SensorQuantity, value: Any) -> None:
        """Set a target of the drive or its torque, clamped to the limit as by the local client.

        Args:
            quantity: The quantity to set.
            value: One number for each joint; None leaves a joint unchanged.

        Raises:
            LabError: If the value does not fit the joints.
        """
        limit: float = getattr(self.cell.options, f"{quantity}_limit")
        entries = entries_of(value, self.cell.plant.joints, quantity)
        clamped = [entry if entry is None else max(-limit, min(entry, limit)) for entry in entries]
        _update(getattr(self.cell.drive, quantity), clamped)

    def set_gains(self, kp: Any, kd: Any) -> None:
        """Set the drive's stiffness in N m/rad and damping in N m s/rad.

        Raises:
            LabError: If the values do not fit the joints, or are negative.
        """
        joints, drive = self.cell.plant.joints, self.cell.drive
        stiffness, damping = _gains(kp, joints, "kp"), _gains(kd, joints, "kd")
        _update(drive.kp, stiffness)
        _update(drive.kd, damping)

    def _deadline(self) -> tuple[float, str]:
        options = self.cell.options
        deadlines = [
            (self.began + self.length + options.session_grace, _over(self.length)),
            (self._last_request + options.heartbeat, f"no request for {options.heartbeat:g} s"),
        ]
        if self.gym is not None:
            deadlines.append((self.gym.ends, "the lease of its gym is over"))
        return min(deadlines)


def entries_of(value: Any, joints: int, name: str) -> list[float | None]:
    """Return one entry for each joint.

    Args:
        value: A number, a list or an array; None entries stay.
        joints: The number of joints.
        name: The name of the value, for the error.

    Raises:
        LabError: If there is not exactly one finite number or None for each joint.
    """
    if joints == 1 and type(value) is float and math.isfinite(value):
        return [value]
    try:
        entries = np.ravel(np.array(value, dtype=object)).tolist()
    except Exception:  # objects may do anything when numpy looks at them
        raise LabError(f"{name} must be a number for each joint, not {shown(value)}") from None
    if len(entries) != joints:
        raise LabError(f"{name} has {len(entries)} entries, but the cell has {joints} joints")
    with as_lab_error():
        return [
            None if entry is None else check_number(f"each entry of {name}", entry)
            for entry in entries
        ]


def _gains(value: Any, joints: int, name: str) -> list[float | None]:
    entries = entries_of(value, joints, name)
    for entry in entries:
        if entry is not None and entry < 0.0:
            raise LabError(f"{name} {entry:g} is outside the limits: it must not be negative")
    return entries


def _over(length: float) -> str:
    return f"its time of {length:g} s is over"


def _update(target: list[float], entries: Sequence[float | None]) -> None:
    target[:] = [old if new is None else new for old, new in zip(target, entries, strict=True)]
