"""The sensors of a cell: quantized, filtered, noisy, with a new sample every 2 ms."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fmugym.lab.lab_options import Options

__all__ = ["Sensors"]

_BLOCK = 64  # rows of random numbers drawn at once, as single draws are slow


class Sensors:
    """The sensors of one cell.

    Args:
        options: The imperfections of the sensors.
        joints: The number of joints.
        rng: The random generator of the noise.

    Attributes:
        sample: The newest readings, a number for each joint: ``"position"`` in rad,
            ``"velocity"`` in rad/s and ``"torque"`` in N m. They stay until the next sample.
    """

    def __init__(self, options: Options, joints: int, rng: np.random.Generator) -> None:
        self._options, self._joints, self._rng = options, joints, rng
        self._step = options.drive_step
        self._period = max(1, round(options.sample_period / self._step))
        lag = options.velocity_lag
        self._gain = 1.0 if lag == 0.0 else -math.expm1(-self._step / lag)
        self._noise: list[list[float]] = []
        self.sample: dict[str, list[float]] = {}

    def restart(self, position: Sequence[float]) -> None:
        """Begin a session with joints at rest, at positions in rad."""
        self._filtered = [0.0] * self._joints
        self._count = 0
        self._take(position, [0.0] * self._joints)

    def observe(
        self, position: Sequence[float], velocity: Sequence[float], torque: Sequence[float]
    ) -> None:
        """Update the filter after one step of the drive, and take a sample if one is due.

        Args:
            position: True angles, in rad.
            velocity: True angular velocities, in rad/s.
            torque: True torques of the motors, in N m.
        """
        gain = self._gain
        self._filtered = [f + gain * (v - f) for f, v in zip(self._filtered, velocity, strict=True)]
        self._count += 1
        if self._count >= self._due:
            self._take(position, torque)

    def _take(self, position: Sequence[float], torque: Sequence[float]) -> None:
        options, (of_velocity, of_torque, early) = self._options, self._draw()
        sigmas = options.velocity_noise[: self._joints]
        velocities = zip(self._filtered, sigmas, of_velocity, strict=True)
        torques = zip(torque, of_torque, strict=True)
        self.sample = {
            "position": list(map(_quantized, position, options.encoder_step)),
            "velocity": [v + sigma * x for v, sigma, x in velocities],
            "torque": [tau + options.torque_noise * x for tau, x in torques],
        }
        is_early = self._period > 1 and early < options.early_sample_share
        self._due = self._count + (self._period // 2 if is_early else self._period)

    def _draw(self) -> tuple[list[float], list[float], float]:
        """Return normal numbers for velocity and torque, and a uniform one from 0 to 1."""
        n = self._joints
        if not self._noise:
            normal = self._rng.standard_normal((_BLOCK, 2 * n))
            uniform = self._rng.random((_BLOCK, 1))
            self._noise = np.concatenate([normal, uniform], axis=1).tolist()
        row = self._noise.pop()
        return row[:n], row[n : 2 * n], row[-1]


def _quantized(position: float, step: float) -> float:
    return step * round(position / step) if step else position
