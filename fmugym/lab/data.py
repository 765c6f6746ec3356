"""What the client takes and gives back."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from datetime import datetime

__all__ = ["ActuatorInfo", "CellInfo", "CellType", "UserInfo"]


class CellType(enum.Enum):
    """The kinds of cells, by their number of joints."""

    SINGLE = "single"
    """A pendulum with one joint."""
    DOUBLE = "double"
    """A pendulum with two joints."""


@dataclass(frozen=True)
class CellInfo:
    """A cell of the lab.

    Attributes:
        cell_id: Its number, for ``start_experiment(cell_id=...)``.
        cell_type: Its kind.
    """

    cell_id: int
    cell_type: CellType


@dataclass(frozen=True)
class UserInfo:
    """What a user may do, and what is left of it.

    Attributes:
        user_name: The user's name.
        number_of_attempts: How many experiments the user may start yet.
        max_experiment_length: Longest experiment or episode, in s.
        bucket_size: How many experiments may be started right now.
        max_bucket_size: How many that are at the most.
        refil_interval: Time after which a bucket that is not full gets one more, in s; spelt as
            the lab spells it.
        valid_from: When the user token begins to be valid.
        valid_until: When it ceases to be.
        experiment_types: The types of experiments the user may start.
        max_gym_length: Longest lease of a gym, in s; 0 without gym permission.
        gym_bucket_size: How many gyms may be started right now.
        gym_max_bucket_size: How many that are at the most.
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
    """One actuator of a cell.

    Attributes:
        name: Which joint it drives.
        motor: The motor of the real cell.
        drive: The drive of the real cell.
        torque_limit: Largest torque, in N m; 0 for a joint that the experiment leaves passive.
        velocity_limit: Angular velocity at which the session ends, in rad/s.
        position_limit: Angle from hanging at which the session ends, in rad.
    """

    name: str
    motor: str
    drive: str
    torque_limit: float
    velocity_limit: float
    position_limit: float
