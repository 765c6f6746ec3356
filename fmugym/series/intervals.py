"""Confidence intervals of means over episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import stdev
from typing import Final

__all__ = ["confidence", "student"]

_Z: Final = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""


def confidence(values: Sequence[float]) -> float | None:
    """Half the width of the 95 % confidence interval of a mean, by Student's distribution.

    Returns:
        The number; None for fewer than two values.
    """
    count = len(values)
    if count < 2:
        return None
    return student(count - 1) * float(stdev(values)) / math.sqrt(count)


def student(freedom: int) -> float:
    """The 97.5 % quantile of Student's distribution.

    For one and two degrees of freedom it is a closed form. For more, see Abramowitz and Stegun,
    "Handbook of Mathematical Functions", 26.7.5; the error is below 1 %.
    """
    if freedom == 1:
        return math.tan(math.pi * 0.475)
    if freedom == 2:
        return 0.95 * math.sqrt(2.0 / (1.0 - 0.95 * 0.95))
    z = _Z
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    total: float = sum(term / freedom**power for power, term in enumerate(terms, 1))
    return z + total
