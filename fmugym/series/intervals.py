"""Confidence intervals of means over episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import variance
from typing import Final

__all__ = ["confidence"]

_Z: Final = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""


def confidence(*groups: Sequence[float]) -> float | None:
    """Half the width of the 95 % confidence interval of a mean, by Student's distribution.

    Args:
        groups: The values. Of several groups, it is that of the sum of their means.

    Returns:
        The number; None for fewer than two values.
    """
    freedom = sum(len(values) - 1 for values in groups)
    if freedom < 1:
        return None
    return _student(freedom) * math.sqrt(sum(variance(values) / len(values) for values in groups))


def _student(freedom: int) -> float:
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
