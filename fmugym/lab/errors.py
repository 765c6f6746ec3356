"""The one error of the lab, a `RuntimeError` as programs for the lab expect."""

from __future__ import annotations

from fmugym.errors import FMUGymError

__all__ = ["LabError"]


class LabError(FMUGymError, RuntimeError):
    """The lab refuses a request, or a session has come to its end.

    Texts that programs for the lab look for:

    * ``Velocity Limit Violation`` and ``VelocityLimitViolation;value=...``, likewise for position
      and torque: the cell was brought to rest and the session ended;
    * ``outside the limits``: an argument is out of its range;
    * ``Too many requests ... try again in N seconds``: too many starts, or an empty bucket.
    """
