"""The checks that come before a lease or a session starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from fmugym.lab.bookings import Bookings
from fmugym.lab.data import CellType
from fmugym.lab.lab_error import LabError
from fmugym.lab.presets import Options
from fmugym.lab.request_checks import Request, check_range
from fmugym.lab.sessions import Gym
from fmugym.lab.users import User

__all__ = ["check_lease", "check_request"]

_LONGEST_PREPARATION: Final = 60.0  # s


def check_lease(bookings: Bookings, user: User, length: Any, wanted: Sequence[CellType]) -> float:
    """Check a request for a lease.

    Args:
        bookings: The lab's bookings.
        user: The user who asks.
        length: Length of the lease, in s.
        wanted: The type of each cell.

    Returns:
        The length, in s.

    Raises:
        LabError: If the length is out of the user's limits, or the lab lacks cells.
    """
    checked = check_range("gym_time", length, user.max_gym_length if user.gym else math.inf)
    for kind in CellType:
        available = sum(cell.cell_type is kind for cell in bookings.cells)
        number = sum(each is kind for each in wanted)
        if number > available:
            raise LabError(f"the lab has {available} cells of type {kind.name}, not {number}")
    return checked


def check_request(
    bookings: Bookings, user: User, options: Options, request: Request, gym: Gym | None
) -> None:
    """Check a request for an experiment, or for an episode of a lease.

    Args:
        bookings: The lab's bookings.
        user: The user who asks.
        options: The lab's options.
        request: The request.
        gym: The lease of an episode, or None.

    Raises:
        LabError: If the user lacks the right, a value is out of its range or no cell fits.
    """
    kind = request.experiment_type
    if kind not in user.experiment_types:
        raise LabError(f"user {user.name!r} may not start experiments of type {kind!r}")
    if not bookings.fitting(request, gym):
        number = "" if request.cell_id is None else f" and number {request.cell_id:g}"
        raise LabError(f"no cell of type {request.cell_type.name}{number} for {kind} exists")
    check_range("the experiment's time", request.length, user.max_experiment_length)
    check_range("preparation_time", request.preparation_time, _LONGEST_PREPARATION, 0.0)
    limit = options.position_limit
    for angle in request.angles:
        check_range("initial_position", angle, limit, -limit)
    _ = request.acting  # raises for a disturbance that does not fit
