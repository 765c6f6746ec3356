"""A disturbance in the course of a session."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from fmugym.lab.disturbance import Disturbance
from fmugym.lab.drive import HOLD_DAMPING

__all__ = ["Acting"]

_PULL_STIFFNESS: Final = 0.43  # N m/rad, as of the controller that holds the start position


class Acting:
    """Applies one disturbance.

    Args:
        disturbance: The disturbance.
    """

    def __init__(self, disturbance: Disturbance) -> None:
        self._disturbance = disturbance
        self._began: float | None = None

    def apply(
        self,
        time: float,
        position: Sequence[float],
        velocity: Sequence[float],
        torque: Sequence[float],
    ) -> list[float]:
        """Add the disturbance to the torques, or replace them while it pulls to a position.

        Args:
            time: Time of the session, in s.
            position: Angles of the joints, in rad.
            velocity: Angular velocities of the joints, in rad/s.
            torque: Torques on the joints, in N m.

        Returns:
            Torques on the joints, in N m.
        """
        disturbance = self._disturbance
        if self._began is None and disturbance.is_due(time, position):
            self._began = time
        if self._began is None or time - self._began >= disturbance.duration:
            return list(torque)
        if disturbance.torque is not None:
            return [own + other for own, other in zip(torque, disturbance.torque, strict=True)]
        targets = disturbance.position or [0.0] * len(position)
        return [
            _PULL_STIFFNESS * (target - q) - HOLD_DAMPING * v
            for target, q, v in zip(targets, position, velocity, strict=False)
        ]
