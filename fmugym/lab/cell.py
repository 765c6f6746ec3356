"""Cell: an FMU instance with its drive and its sensors.

The drive is impedance control of each joint, with limited torque. The sensors are quantized,
filtered and noisy, with a new sample every 2 ms.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any, Final

import numpy as np

from fmugym.checks import check_mapping
from fmugym.environment.fmu_variables import start_variable
from fmugym.errors import ConfigError, SimulationError
from fmugym.fmi.bundled import bundled_fmu
from fmugym.fmi.fmu import FMU
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.variable import checked_value
from fmugym.lab.data import EXPERIMENTS, PLANTS, CellType, LabError
from fmugym.lab.lab_options import Options
from fmugym.pool import Pool, PoolSpec
from fmugym.pool.opening import open_pool

__all__ = ["HOLD_DAMPING", "Cell", "Drive", "Sensors", "checked_parameters"]

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


logger = logging.getLogger(__name__)

_HOLD_TIME: Final = 3.0  # s until a held arm is at rest
_AT_REST: Final = 1e-4  # rad/s


class Cell:
    """A simulated cell. The first start creates its FMU instance, and later starts reuse it.

    Args:
        cell_id: The cell's number.
        cell_type: The cell's type.
        options: Options of the simulated cell.
        rng: The random generator of its noise and its friction.
        parameters: Parameters of its FMU that differ from the bundled values.

    Attributes:
        cell_id: The cell's number.
        cell_type: The cell's type.
        options: Options of the simulated cell.
        plant: Its FMU and the names of the variables.
        position: True angles, in rad.
        velocity: True angular velocities, in rad/s.
        torque: Torques of the motors over the last step, in N m.
        drive: The drive of the present session.
        sensors: The sensors.
        fault: Why it came to rest early, in the words that clients get, or None.
    """

    def __init__(
        self,
        cell_id: int,
        cell_type: CellType,
        options: Options,
        rng: np.random.Generator,
        parameters: Mapping[str, float],
    ) -> None:
        self.cell_id, self.cell_type = cell_id, cell_type
        self.plant = PLANTS[cell_type]
        self.options = options
        self._parameters = dict(self.plant.parameters)
        if self.plant.coulomb_friction is not None:
            friction = float(rng.uniform(*options.coulomb_friction))
            self._parameters[self.plant.coulomb_friction] = friction
        self._parameters |= parameters
        self._pool: Pool | None = None
        self._is_closed = False
        self._simulating = threading.Lock()  # one cell may prepare while the lab serves others
        self.sensors = Sensors(options, self.plant.joints, rng)
        self.park()

    def park(self) -> None:
        """Let the arm hang at rest, without a session."""
        joints = self.plant.joints
        self.position, self.velocity = [0.0] * joints, [0.0] * joints
        self.torque = [0.0] * joints
        self.drive = Drive(self.options, [True] * joints)
        self.fault: str | None = None
        self._steps = 0

    def start(self, experiment: str, position: Sequence[float]) -> None:
        """Bring the arm to its start position and release it.

        Args:
            experiment: The type of experiment.
            position: The requested angles, in rad.

        Raises:
            SimulationError: If the FMU refuses its parameters.
        """
        self.park()
        spec = EXPERIMENTS[experiment]
        with self._simulating:
            self._reset(position, spec.parameters)
            if math.isfinite(self.options.hold_stiffness):
                self._hold(position)
        self.velocity = [0.0] * self.plant.joints
        self.drive = Drive(self.options, spec.driven)
        self.sensors.restart(self.position)

    def advance(self, elapsed: float) -> None:
        """Simulate the arm, in whole steps of the drive.

        Args:
            elapsed: Time since the start, in s.
        """
        goal = math.floor(elapsed / self.options.drive_step + 1e-6)
        with self._simulating:
            while self._steps < goal and self.fault is None:
                self._step()

    @property
    def time(self) -> float:
        """Simulated time of the session, in s."""
        return self._steps * self.options.drive_step

    def close(self) -> None:
        """Free the instance for good; a second call does nothing."""
        with self._simulating:
            self._is_closed = True
            if self._pool is not None:
                self._pool.close()
                self._pool = None

    def _open(self) -> Pool:
        if self._is_closed:
            raise LabError("the lab is closed")
        if self._pool is None:
            fmu = FMU(bundled_fmu(self.plant.model))
            spec = PoolSpec(
                inputs=tuple(map(fmu.variable, self.plant.torques)),
                outputs=tuple(map(fmu.variable, self.plant.positions + self.plant.velocities)),
                time_step=self.options.drive_step,
            )
            names = (*self.plant.start_positions, *self._parameters)
            self._start_variables = tuple(map(fmu.variable, names))
            self._pool = open_pool(fmu, spec, 1, logger)
        return self._pool

    def _reset(self, position: Sequence[float], changes: Mapping[str, float]) -> None:
        pool = self._open()
        parameters = {name: changes.get(name, self._parameters[name]) for name in self._parameters}
        values = np.array([[*position, *parameters.values()]], float).T
        _, statuses = pool.reset(self._start_variables, values)
        if statuses[0] > WARNING_CODE:
            raise SimulationError(f"cell {self.cell_id} cannot start: {pool.failure(0)}")
        self._read(pool)

    def _hold(self, position: Sequence[float]) -> None:
        """Hold the arm without gravity compensation until it is at rest, so that it sags."""
        hold = Drive(self.options, [True] * self.plant.joints)
        hold.position = list(position)
        hold.kp = [self.options.hold_stiffness] * self.plant.joints
        hold.kd = [HOLD_DAMPING] * self.plant.joints
        for step in range(round(_HOLD_TIME / self.options.drive_step)):
            self._push(hold.evaluate(self.position, self.velocity))
            if step % 100 == 99 and max(map(abs, self.velocity)) < _AT_REST:
                break

    def _step(self) -> None:
        self.torque = self.drive.evaluate(self.position, self.velocity)
        self._push(self.torque)
        self._steps += 1
        self.sensors.observe(self.position, self.velocity, self.torque)
        self._check_limits()

    def _push(self, torque: Sequence[float]) -> None:
        pool = self._open()
        pool.inputs[:, 0] = torque
        if pool.step_own():
            self.fault = f"the cell failed: {pool.failure(0)}"
        self._read(pool)

    def _read(self, pool: Pool) -> None:
        state: list[float] = pool.outputs[:, 0].tolist()
        self.position, self.velocity = state[: self.plant.joints], state[self.plant.joints :]

    def _check_limits(self) -> None:
        options = self.options
        for kind, values, limit in (
            ("Position", self.position, options.position_limit),
            ("Velocity", self.velocity, options.velocity_limit),
        ):
            for joint, value in enumerate(values):
                if abs(value) > limit and self.fault is None:
                    self.fault = self._violation(kind, joint, value, limit)

    def _violation(self, kind: str, joint: int, value: float, limit: float) -> str:
        return (
            f"{kind}LimitViolation;value={value:.6g};{kind} Limit Violation: {value:.6g} at the "
            f"{self.plant.joint_names[joint]} of cell {self.cell_id} is beyond {limit:.6g}; "
            "the motors were brought to rest"
        )


def checked_parameters(cell_type: CellType, parameters: Mapping[str, Any]) -> dict[str, float]:
    """Check parameters of the FMU that simulates a type of cell.

    Args:
        cell_type: The type of cell.
        parameters: Values by name; items of an enumeration may be given by name.

    Returns:
        The values as numbers.

    Raises:
        ConfigError: If a parameter does not exist, cannot be set, or has a wrong value.
    """
    plant = PLANTS[cell_type]
    values = check_mapping(f"parameters of {cell_type.name} cells", parameters)
    checked = {}
    with closing(FMU(bundled_fmu(plant.model))) as fmu:
        for name, value in values.items():
            if name in plant.start_positions:
                raise ConfigError(f"{name!r} is the start position; use initial_position")
            variable = start_variable(fmu.description, name, value)
            checked[name] = checked_value(variable, value)
    return checked
