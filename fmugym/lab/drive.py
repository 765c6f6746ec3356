"""The drive of a cell: impedance control of each joint, with limited torque."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from fmugym.lab.lab_options import Options

__all__ = ["HOLD_DAMPING", "Drive"]

HOLD_DAMPING: Final = 0.03
"""Damping of the controller that holds an arm, in N m s/rad; about critical for the single
pendulum."""


class Drive:
    """The control law tau = kp (q* - q) + kd (qd* - qd) + tau_ff for each joint.

    The hardware evaluates it at 40 kHz; this drive evaluates it once in ``Options.drive_step``.
    A spring torque that is constant over a step would pump energy into the joint, like a damping
    of -kp step / 2. The law therefore uses the angle that the present velocity gives for the
    middle of the step.

    Args:
        options: The limits and the step.
        driven: Whether each joint has torque.

    Attributes:
        position: q* of each joint, in rad.
        velocity: qd* of each joint, in rad/s.
        torque: tau_ff of each joint, in N m.
        kp: Stiffness of each joint, in N m/rad.
        kd: Damping of each joint, in N m s/rad.
    """

    def __init__(self, options: Options, driven: Sequence[bool]) -> None:
        zeros = [0.0] * len(driven)
        self.position, self.velocity, self.torque = zeros[:], zeros[:], zeros[:]
        self.kp, self.kd = zeros[:], zeros[:]
        self._limits = [options.torque_limit if is_driven else 0.0 for is_driven in driven]
        self._ahead = 0.5 * options.drive_step

    def evaluate(self, position: Sequence[float], velocity: Sequence[float]) -> list[float]:
        """Return the torque of each joint over the next step, in N m.

        Args:
            position: True angles, in rad.
            velocity: True angular velocities, in rad/s.
        """
        ahead = self._ahead
        return [
            min(
                max(kp * (aim - q - v * ahead) + kd * (rate - v) + feed, -limit),
                limit,
            )
            for q, v, kp, aim, kd, rate, feed, limit in zip(
                position,
                velocity,
                self.kp,
                self.position,
                self.kd,
                self.velocity,
                self.torque,
                self._limits,
                strict=True,
            )
        ]
