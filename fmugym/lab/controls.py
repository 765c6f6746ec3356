"""The requests of a program to a running session."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from fmugym.lab.data import ActuatorInfo
from fmugym.lab.experiments import EXPERIMENTS
from fmugym.lab.lab_error import LabError
from fmugym.lab.presets import Options
from fmugym.lab.request_checks import entries_of, gains_of
from fmugym.lab.sessions import Session

__all__ = ["Quantity", "actuators", "command", "read", "set_gains"]

Quantity = Literal["position", "velocity", "torque"]


def read(session: Session, quantity: Quantity) -> float | list[float]:
    """Return the newest reading: a float for one actuator, a list for two."""
    values: list[float] = getattr(session.cell.sensors.sample, quantity)
    return values[0] if len(values) == 1 else list(values)


def command(session: Session, options: Options, quantity: Quantity, value: Any) -> None:
    """Set a target of the drive, or its torque.

    Args:
        session: The session.
        options: The limits, and whether values are clamped to them.
        quantity: What to set.
        value: One number for each joint; None leaves a joint unchanged.

    Raises:
        LabError: If the value does not fit the joints, or is refused because of a limit.
    """
    cell = session.cell
    entries = entries_of(value, cell.plant.joints, quantity)
    limited = [_limited(entry, options, quantity) for entry in entries]
    _update(getattr(cell.drive, quantity), limited)


def set_gains(session: Session, kp: Any, kd: Any) -> None:
    """Set the drive's stiffness in N m/rad and damping in N m s/rad.

    Raises:
        LabError: If the values do not fit the joints, or are negative.
    """
    joints, drive = session.cell.plant.joints, session.cell.drive
    stiffness, damping = gains_of(kp, joints, "kp"), gains_of(kd, joints, "kd")
    _update(drive.kp, stiffness)
    _update(drive.kd, damping)
    session.note(f"kp {drive.kp} N m/rad, kd {drive.kd} N m s/rad")


def actuators(session: Session, options: Options) -> list[ActuatorInfo]:
    """Describe the actuator of each joint."""
    driven = EXPERIMENTS[session.experiment].driven
    return [
        ActuatorInfo(
            name=name,
            motor="T-Motor GL35 (simulated)",
            drive="MAB MD80 (simulated)",
            torque_limit=options.torque_limit if is_driven else 0.0,
            velocity_limit=options.velocity_limit,
            position_limit=options.position_limit,
        )
        for name, is_driven in zip(session.cell.plant.joint_names, driven, strict=True)
    ]


def _limited(value: float | None, options: Options, quantity: Quantity) -> float | None:
    limit: float = getattr(options, f"{quantity}_limit")
    if value is None or abs(value) <= limit:
        return value
    if options.clamp_setters:
        return math.copysign(limit, value)
    raise LabError(f"{quantity} {value:g} is outside the limits of +-{limit:g}")


def _update(target: list[float], entries: Sequence[float | None]) -> None:
    target[:] = [old if new is None else new for old, new in zip(target, entries, strict=True)]
