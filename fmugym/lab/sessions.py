"""Leases, experiments and episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from fmugym.lab.cell import Cell
from fmugym.lab.cell_pictures import LiveView
from fmugym.lab.data import ActuatorInfo, LabError
from fmugym.lab.experiments import EXPERIMENTS
from fmugym.lab.request_checks import entries_of, gains_of
from fmugym.lab.users import Account
from fmugym.lab.videos import Recording

__all__ = ["Gym", "Session"]

Quantity = Literal["position", "velocity", "torque"]


@dataclass(eq=False)
class Gym:
    """A lease of several cells.

    Attributes:
        token: The gym token.
        account: The user's account.
        cells: The leased cells.
        ends: When the lease ends, in s of the lab's time.
        ended: Why it has ended, or None.
        is_stopped: Whether the user has stopped it.
        view: The picture of its cells, or None before the first one.
    """

    token: str
    account: Account
    cells: list[Cell]
    ends: float
    ended: str | None = None
    is_stopped: bool = False
    view: LiveView | None = None
    kind: ClassVar[str] = "gym"

    def bring_to(self, now: float) -> None:
        """End the lease if its time is over; ``now`` is the lab's time in s."""
        if self.ended is None and now >= self.ends:
            self.end("its time is over")

    def end(self, reason: str) -> None:
        """End the lease."""
        if self.ended is None:
            self.ended = f"the gym has ended: {reason}"
            if self.view is not None:
                self.view.close()

    def stop(self) -> None:
        """End the lease at the user's request; see `Session.stop`."""
        _stop(self)


@dataclass(eq=False)
class Session:
    """One use of one cell: an experiment or an episode.

    Attributes:
        token: The session or episode token.
        cell: The cell.
        experiment: The type of the experiment.
        began: When it began, in s of the lab's time.
        length: How long it may last, in s.
        heartbeat: Longest time without a request, in s.
        grace: How much longer than `length` it lasts, in s.
        gym: The lease of an episode, or None.
        recording: The recording of the cell, or None.
        ended: Why it has ended, or None.
        is_stopped: Whether the user has stopped it.
        log: One line for each event.
    """

    token: str
    cell: Cell
    experiment: str
    began: float
    length: float
    heartbeat: float
    grace: float
    gym: Gym | None
    recording: Recording | None
    ended: str | None = None
    is_stopped: bool = False
    log: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._last_request = self.began
        self.note(f"{self.experiment} on cell {self.cell.cell_id}, {self.length:g} s")

    @property
    def kind(self) -> str:
        """The name that error texts use."""
        return "experiment" if self.gym is None else "episode"

    def note(self, text: str) -> None:
        """Add a line to the log."""
        if len(self.log) < 1000:
            self.log.append(f"{self.cell.time:9.4f} s  {text}")

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

    def _end(self, reason: str) -> None:
        if self.ended is not None:
            return
        self.note(reason)
        self.ended = reason
        if self.recording is not None:
            self.recording.cut(min(self.cell.time, self.length))
        self.cell.park()

    def stop(self) -> None:
        """End the session at the user's request, even if it has already ended by itself.

        Raises:
            LabError: If the user has already stopped it.
        """
        _stop(self)

    # What a program asks for while it runs.

    def read(self, quantity: Quantity) -> float | list[float]:
        """Return the newest reading: a float for one actuator, a list for two."""
        values = self.cell.sensors.sample[quantity]
        return values[0] if len(values) == 1 else list(values)

    def command(self, quantity: Quantity, value: Any) -> None:
        """Set a target of the drive, or its torque.

        Args:
            quantity: What to set.
            value: One number for each joint; None leaves a joint unchanged.

        Raises:
            LabError: If the value does not fit the joints, or is refused because of a limit.
        """
        entries = entries_of(value, self.cell.plant.joints, quantity)
        limited = [self._limited(entry, quantity) for entry in entries]
        _update(getattr(self.cell.drive, quantity), limited)

    def set_gains(self, kp: Any, kd: Any) -> None:
        """Set the drive's stiffness in N m/rad and damping in N m s/rad.

        Raises:
            LabError: If the values do not fit the joints, or are negative.
        """
        joints, drive = self.cell.plant.joints, self.cell.drive
        stiffness, damping = gains_of(kp, joints, "kp"), gains_of(kd, joints, "kd")
        _update(drive.kp, stiffness)
        _update(drive.kd, damping)
        self.note(f"kp {drive.kp} N m/rad, kd {drive.kd} N m s/rad")

    def actuators(self) -> list[ActuatorInfo]:
        """Describe the actuator of each joint."""
        options, driven = self.cell.options, EXPERIMENTS[self.experiment].driven
        return [
            ActuatorInfo(
                name=name,
                motor="T-Motor GL35 (simulated)",
                drive="MAB MD80 (simulated)",
                torque_limit=options.torque_limit if is_driven else 0.0,
                velocity_limit=options.velocity_limit,
                position_limit=options.position_limit,
            )
            for name, is_driven in zip(self.cell.plant.joint_names, driven, strict=True)
        ]

    def events(self) -> str:
        """The log as a text."""
        return "\n".join(self.log)

    def _limited(self, value: float | None, quantity: Quantity) -> float | None:
        limit: float = getattr(self.cell.options, f"{quantity}_limit")
        if value is None or abs(value) <= limit:
            return value
        if self.cell.options.clamp_setters:
            return math.copysign(limit, value)
        raise LabError(f"{quantity} {value:g} is outside the limits of +-{limit:g}")

    def _deadline(self) -> tuple[float, str]:
        deadlines = [
            (self.began + self.length + self.grace, f"its time of {self.length:g} s is over"),
            (self._last_request + self.heartbeat, f"no request for {self.heartbeat:g} s"),
        ]
        if self.gym is not None:
            deadlines.append((self.gym.ends, "the lease of its gym is over"))
        return min(deadlines)


def _stop(owner: Gym | Session) -> None:
    if owner.is_stopped:
        raise LabError(f"the {owner.kind} was stopped before")
    owner.is_stopped = True
    owner.end("it was stopped")


def _update(target: list[float], entries: Sequence[float | None]) -> None:
    target[:] = [old if new is None else new for old, new in zip(target, entries, strict=True)]
