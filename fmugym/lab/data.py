"""Experiments: their types, and the FMUs that simulate the cells; data of the client's methods.

``LabError`` is the error that these methods raise.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

from fmugym.errors import FMUGymError

__all__ = [
    "EXPERIMENTS",
    "PLANTS",
    "CellType",
    "Experiment",
    "JointPlant",
    "LabError",
    "UserInfo",
    "as_lab_error",
]


class CellType(enum.Enum):
    """The types of cells, by their number of joints."""

    SINGLE = "single"
    """A pendulum with one joint."""
    DOUBLE = "double"
    """A pendulum with two joints."""


@dataclass(frozen=True)
class UserInfo:
    """A user's rights, as the real lab tells them.

    The simulated lab keeps the two limits of time. It counts no attempts, so the other numbers
    never change. All numbers are nominal: those of the real lab are not public.

    Attributes:
        number_of_attempts: How many more experiments the user may start.
        max_experiment_length: Longest experiment or episode, in s.
        max_gym_length: Longest lease of cells, in s.
        gym_bucket_size: How many leases the user may start right now.
        gym_max_bucket_size: The largest value of ``gym_bucket_size``.
    """

    number_of_attempts: int = 1000
    max_experiment_length: float = 60.0
    max_gym_length: float = 3600.0
    gym_bucket_size: int = 20
    gym_max_bucket_size: int = 20


class LabError(FMUGymError, RuntimeError):
    """The lab refuses a request, or a session has ended.

    Programs for the real lab expect a `RuntimeError`, and look for these texts:

    * ``Velocity Limit Violation`` and ``VelocityLimitViolation;value=...``, and the same for the
      position: the cell was brought to rest and the session ended.
    * ``outside the limits``: an argument is out of its range.
    """


@contextmanager
def as_lab_error() -> Iterator[None]:
    """Turn other errors of this package into a `LabError` with the same text."""
    try:
        yield
    except LabError:
        raise
    except FMUGymError as error:
        raise LabError(str(error)) from None


_UNLIMITED_TORQUE: Final = 10.0  # N m; the lab's drive limits the torque, before disturbances
_UNLIMITED_VELOCITY: Final = 1000.0  # rad/s; the lab ends a session at a lower velocity


@dataclass(frozen=True)
class JointPlant:
    """An FMU and the names of its variables, joint by joint.

    Attributes:
        model: The name of the bundled FMU.
        torques: Inputs, in N m.
        positions: Outputs, in rad, 0 hanging.
        velocities: Outputs, in rad/s.
        start_positions: Parameters, in rad.
        parameters: Values of further parameters by name.
        coulomb_friction: The parameter that ``Options.coulomb_friction`` sets, or None.
        joint_names: The names of the joints.
    """

    model: str
    torques: tuple[str, ...]
    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    start_positions: tuple[str, ...]
    parameters: Mapping[str, float]
    coulomb_friction: str | None
    joint_names: tuple[str, ...]

    @property
    def joints(self) -> int:
        """The number of joints."""
        return len(self.torques)


PLANTS: Final = {
    CellType.SINGLE: JointPlant(
        model="Pendulum",
        torques=("tau",),
        positions=("q",),
        velocities=("q_dot",),
        start_positions=("q_0",),
        parameters={"tau_max": _UNLIMITED_TORQUE, "theta_dot_max": _UNLIMITED_VELOCITY, "g": 9.81},
        coulomb_friction="c",
        joint_names=("pivot",),
    ),
    CellType.DOUBLE: JointPlant(
        model="DoublePendulum",
        torques=("tau1", "tau2"),
        positions=("q1", "q2"),
        velocities=("q1_dot", "q2_dot"),
        start_positions=("q1_0", "q2_0"),
        parameters={
            "tau_max1": _UNLIMITED_TORQUE,
            "tau_max2": _UNLIMITED_TORQUE,
            "q_dot_max": _UNLIMITED_VELOCITY,
        },
        coulomb_friction=None,
        joint_names=("shoulder", "elbow"),
    ),
}


@dataclass(frozen=True)
class Experiment:
    """A type of experiment.

    Attributes:
        cell_type: The type of cell that it needs.
        driven: Whether each joint has torque.
        parameters: Values of the plant's parameters that it changes.
    """

    cell_type: CellType
    driven: tuple[bool, ...]
    parameters: Mapping[str, float] = field(default_factory=dict)


EXPERIMENTS: Final = {
    "DoubleIntegrator": Experiment(CellType.SINGLE, (True,), {"g": 0.0}),
    "SimplePendulum": Experiment(CellType.SINGLE, (True,)),
    "DoublePendulum": Experiment(CellType.DOUBLE, (True, True)),
    "Acrobot": Experiment(CellType.DOUBLE, (False, True)),
    "Pendubot": Experiment(CellType.DOUBLE, (True, False)),
}
