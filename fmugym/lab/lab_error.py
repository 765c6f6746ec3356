"""The error of the lab. It is a `RuntimeError`, as programs for the real lab expect."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from fmugym.errors import FMUGymError

__all__ = ["LabError", "as_lab_error"]


class LabError(FMUGymError, RuntimeError):
    """The lab refuses a request, or a session has ended.

    Programs for the lab look for these texts:

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
