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

    For one and two degrees of freedom it is a closed form. For more, the error is below 1 %: see
    Peizer and Pratt, "A normal approximation for binomial, F, beta, and other common, related tail
    probabilities", Journal of the American Statistical Association 63 (1968).
    """
    if freedom == 1:
        return math.tan(math.pi * 0.475)
    if freedom == 2:
        return 0.95 * math.sqrt(2.0 / (1.0 - 0.95 * 0.95))
    scaled = _Z / (freedom - 2 / 3 + 0.1 / freedom)
    return math.sqrt(freedom * math.expm1((freedom - 5 / 6) * scaled**2))
