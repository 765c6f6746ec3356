"""What the client's methods give: data, and the error that they raise."""

from __future__ import annotations

import enum
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime

from fmugym.errors import FMUGymError

__all__ = ["ActuatorInfo", "CellInfo", "CellType", "LabError", "UserInfo", "as_lab_error"]


class CellType(enum.Enum):
    """The types of cells, by their number of joints."""

    SINGLE = "single"
    """A pendulum with one joint."""
    DOUBLE = "double"
    """A pendulum with two joints."""


@dataclass(frozen=True)
class CellInfo:
    """A cell of the lab.

    Attributes:
        cell_id: The cell's number, for ``start_experiment(cell_id=...)``.
        cell_type: The cell's type.
    """

    cell_id: int
    cell_type: CellType


@dataclass(frozen=True)
class UserInfo:
    """A user's rights, and how much of them is left.

    Attributes:
        user_name: The user's name.
        number_of_attempts: How many more experiments the user may start.
        max_experiment_length: Longest experiment or episode, in s.
        bucket_size: How many experiments the user may start right now.
        max_bucket_size: The largest value of ``bucket_size``.
        refil_interval: Time after which ``bucket_size`` grows by one, in s. The lab spells it
            this way.
        valid_from: When the user token becomes valid.
        valid_until: When the user token expires.
        experiment_types: The types of experiments the user may start.
        max_gym_length: Longest lease of a gym, in s; 0 without gym permission.
        gym_bucket_size: How many gyms the user may start right now.
        gym_max_bucket_size: The largest value of ``gym_bucket_size``.
    """

    user_name: str
    number_of_attempts: int
    max_experiment_length: float
    bucket_size: int
    max_bucket_size: int
    refil_interval: float
    valid_from: datetime
    valid_until: datetime
    experiment_types: tuple[str, ...]
    max_gym_length: float
    gym_bucket_size: int
    gym_max_bucket_size: int


@dataclass(frozen=True)
class ActuatorInfo:
    """An actuator of a cell.

    Attributes:
        name: The joint that it drives.
        motor: The motor of the real cell.
        drive: The drive of the real cell.
        torque_limit: Largest torque, in N m; 0 for a joint that is passive in the experiment.
        velocity_limit: Angular velocity at which the session ends, in rad/s.
        position_limit: Angle from hanging at which the session ends, in rad.
    """

    name: str
    motor: str
    drive: str
    torque_limit: float
    velocity_limit: float
    position_limit: float


class LabError(FMUGymError, RuntimeError):
    """The lab refuses a request, or a session has ended.

    Programs for the real lab expect a `RuntimeError`, and look for these texts:

    * ``Velocity Limit Violation`` and ``VelocityLimitViolation;value=...``, and the same for
      position and torque: the cell was brought to rest and the session ended.
    * ``outside the limits``: an argument is out of its range.
    * ``Too many requests ... try again in N seconds``: too many starts, or an empty bucket.
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
