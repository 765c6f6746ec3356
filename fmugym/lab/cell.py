"""A cell: an FMU instance, the drive that moves it and the sensors that watch it."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fmugym.archive.bundled import bundled_fmu
from fmugym.archive.fmu import FMU
from fmugym.lab.data import CellType
from fmugym.lab.disturbance import Disturbance
from fmugym.lab.drive import Drive
from fmugym.lab.errors import LabError
from fmugym.lab.experiments import EXPERIMENTS, PLANTS
from fmugym.lab.presets import Options
from fmugym.lab.recording import Recording
from fmugym.lab.sensors import Sensors
from fmugym.pool import Pool, PoolSpec
from fmugym.trial.opening import make_pool

__all__ = ["Cell", "Fault"]

logger = logging.getLogger(__name__)

_HOLD_DAMPING: Final = 0.03  # N m s/rad, about critical for the single pendulum
_HOLD_TIME: Final = 3.0  # s until the held arm rests
_AT_REST: Final = 1e-4  # rad/s
_PULL_STIFFNESS: Final = 0.43  # N m/rad, of position disturbances: that of the start position


@dataclass(frozen=True)
class Fault:
    """Why a cell came to rest before its time.

    Attributes:
        time: Time of the session, in s.
        text: The reason, as clients get it.
    """

    time: float
    text: str


class Cell:
    """A simulated cell. Its instance is made at the first start and used again by later ones.

    Args:
        cell_id: Its number.
        cell_type: Its kind.
        options: What is simulated.
        rng: For its noise and its own parameters.
        parameters: Parameters of its FMU that differ from the bundled values.

    Attributes:
        cell_id: Its number.
        cell_type: Its kind.
        plant: Its FMU and the names in it.
        position: True angles, in rad.
        velocity: True angular velocities, in rad/s.
        torque: Torques of the motors over the last step, in N m.
        drive: The drive of the present session.
        sensors: The sensors.
        fault: Why it came to rest, or None.
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
        self._options = options
        self._parameters = dict(self.plant.parameters)
        if self.plant.coulomb_friction is not None:
            friction = float(rng.uniform(*options.coulomb_friction))
            self._parameters[self.plant.coulomb_friction] = friction
        self._parameters |= parameters
        self._pool: Pool | None = None
        self._is_closed = False
        self._simulating = threading.Lock()  # a cell gets ready while the others go on
        self.sensors = Sensors(options, self.plant.joints, rng)
        self.park()

    def park(self) -> None:
        """Let the arm hang at rest, without a session."""
        joints = self.plant.joints
        self.position, self.velocity = [0.0] * joints, [0.0] * joints
        self.torque = [0.0] * joints
        self.drive = Drive(self._options, [True] * joints)
        self.fault: Fault | None = None
        self.recording: Recording | None = None
        self._steps = 0
        self._disturbances: list[_Acting] = []

    def start(
        self,
        experiment: str,
        position: Sequence[float],
        disturbances: Sequence[Disturbance] = (),
        recording: Recording | None = None,
    ) -> None:
        """Bring the arm to its start position and release it.

        Args:
            experiment: The type of experiment.
            position: The angles asked for, in rad.
            disturbances: What will disturb the session.
            recording: Gets the angles and torques.
        """
        self.park()
        spec = EXPERIMENTS[experiment]
        with self._simulating:
            self._reset(position, spec.parameters)
            if math.isfinite(self._options.hold_stiffness):
                self._hold(position)
        self.velocity = [0.0] * self.plant.joints
        self.torque = [0.0] * self.plant.joints
        self.drive = Drive(self._options, spec.driven)
        self._disturbances = [_Acting(each) for each in disturbances]
        self.recording = recording
        self.sensors.restart(self.position)
        self._record()

    def advance(self, elapsed: float) -> None:
        """Let the arm move on.

        Args:
            elapsed: Time since the start, in s; the last whole step before it is the last done.
        """
        goal = math.floor(elapsed / self._options.drive_step + 1e-6)
        with self._simulating:
            while self._steps < goal and self.fault is None:
                self._step()

    @property
    def time(self) -> float:
        """Time of the session that was simulated, in s."""
        return self._steps * self._options.drive_step

    def close(self) -> None:
        """Free the instance, for ever; more than one call is fine."""
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
                time_step=self._options.drive_step,
            )
            names = (*self.plant.start_positions, *self._parameters)
            self._start_variables = tuple(map(fmu.variable, names))
            self._pool = make_pool(fmu, spec, 1, logger)
        return self._pool

    def _reset(self, position: Sequence[float], changes: Mapping[str, float]) -> None:
        pool = self._open()
        parameters = {name: changes.get(name, self._parameters[name]) for name in self._parameters}
        values = np.array([[*position, *parameters.values()]], float).T
        pool.reset(self._start_variables, values)
        self._read(pool)

    def _hold(self, position: Sequence[float]) -> None:
        """Let the arm sag: it is held without compensation of gravity, until it rests."""
        hold = Drive(self._options, [True] * self.plant.joints)
        hold.position = list(position)
        hold.kp = [self._options.hold_stiffness] * self.plant.joints
        hold.kd = [_HOLD_DAMPING] * self.plant.joints
        for step in range(round(_HOLD_TIME / self._options.drive_step)):
            self._push(hold.evaluate(self.position, self.velocity))
            if step % 100 == 99 and max(map(abs, self.velocity)) < _AT_REST:
                break

    def _step(self) -> None:
        total = self.torque = self.drive.evaluate(self.position, self.velocity)
        for each in self._disturbances:
            total = each.apply(self.time, self.position, self.velocity, total)
        self._push(total)
        self._steps += 1
        self.sensors.observe(self.position, self.velocity, self.torque)
        self._record()
        self._check_limits()

    def _push(self, torque: Sequence[float]) -> None:
        pool = self._open()
        pool.inputs[:, 0] = torque
        if pool.step_own():
            self.fault = Fault(self.time, f"the cell failed: {pool.failure(0)}")
        self._read(pool)

    def _read(self, pool: Pool) -> None:
        state: list[float] = pool.outputs[:, 0].tolist()
        self.position, self.velocity = state[: self.plant.joints], state[self.plant.joints :]

    def _record(self) -> None:
        if self.recording is not None:
            self.recording.observe(self.time, self.position, self.torque)

    def _check_limits(self) -> None:
        options = self._options
        for kind, values, limit in (
            ("Position", self.position, options.position_limit),
            ("Velocity", self.velocity, options.velocity_limit),
            ("Torque", self.torque, options.torque_limit),
        ):
            for joint, value in enumerate(values):
                if abs(value) > limit and self.fault is None:
                    self.fault = Fault(self.time, self._violation(kind, joint, value, limit))

    def _violation(self, kind: str, joint: int, value: float, limit: float) -> str:
        return (
            f"{kind}LimitViolation;value={value:.6g};{kind} Limit Violation: {value:.6g} at the "
            f"{self.plant.joint_names[joint]} of cell {self.cell_id} is beyond {limit:.6g}; "
            "the motors were brought to rest"
        )


class _Acting:
    """A disturbance in the course of a session."""

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
        """Return the torque of each joint with the disturbance's part, in N m."""
        disturbance = self._disturbance
        if self._began is None and disturbance.is_due(time, position):
            self._began = time
        if self._began is None or time - self._began >= disturbance.duration:
            return list(torque)
        if disturbance.torque is not None:
            return [own + other for own, other in zip(torque, disturbance.torque, strict=True)]
        aims = disturbance.position or [0.0] * len(position)
        return [
            _PULL_STIFFNESS * (aim - q) - _HOLD_DAMPING * v
            for aim, q, v in zip(aims, position, velocity, strict=False)
        ]
