"""Pairing of actions with measured values, by the relative gain array."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from typing import Final

import numpy as np

from fmugym.pool.base import FloatArray

__all__ = ["MOST_PAIRED", "best_pairing", "niederlinski_index", "relative_gains"]

MOST_PAIRED: Final = 8
"""Actions that are paired, at most, as all orders are tried."""

_LEAST: Final = 1e-6
"""A relative gain below this is none: such a pair has no effect once the other loops are closed."""


def relative_gains(gains: FloatArray) -> FloatArray:
    """The relative gain array of Bristol (1966): each gain, beside that with all others controlled.

    Args:
        gains: Gains of each measured value by each action, shape (n, n).
    """
    relative: FloatArray = gains * np.linalg.pinv(gains).T
    return relative


def niederlinski_index(gains: FloatArray, pairing: Sequence[int]) -> float:
    """The index of Niederlinski (1971); loops with integrals are unstable if it is negative.

    Args:
        gains: As for ``relative_gains``.
        pairing: The row of each column.
    """
    paired = gains[list(pairing)]
    return float(np.linalg.det(paired) / np.prod(np.diag(paired)))


def best_pairing(gains: FloatArray) -> tuple[tuple[int, ...], float] | None:
    """The row of each column whose loops disturb each other least.

    Relative gains of pairs are positive, and so is the index of Niederlinski. Of such pairings, the
    relative gain array of the best one is nearest to that of loops that do not touch each other, by
    the sum of all differences (the RGA number of Skogestad and Postlethwaite, 2005).

    Returns:
        The pairing and its RGA number; None if there is no such pairing.
    """
    relative = relative_gains(gains)
    size = len(gains)
    allowed = (
        pairing
        for pairing in permutations(range(size))
        if (relative[pairing, range(size)] > _LEAST).all()
        and niederlinski_index(gains, pairing) > 0
    )
    numbers = {one: float(np.abs(relative[list(one)] - np.eye(size)).sum()) for one in allowed}
    best = min(numbers, key=numbers.__getitem__, default=None)
    return None if best is None else (best, numbers[best])
