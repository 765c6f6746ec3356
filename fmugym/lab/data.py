"""Data of the client's methods, and the error that they raise."""

from __future__ import annotations

import enum
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fmugym.errors import FMUGymError

__all__ = ["CellType", "LabError", "UserInfo", "as_lab_error"]


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
