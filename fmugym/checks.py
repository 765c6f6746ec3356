"""Checks of single values that many arguments share."""

from __future__ import annotations

import math
from numbers import Real
from typing import Any

import numpy as np

from fmugym.errors import ConfigError

__all__ = ["check_count", "check_number", "number_of"]


def check_number(
    what: str, value: Any, minimum: float = -math.inf, *, positive: bool = False
) -> None:
    """Refuse what is no finite number in its range.

    Args:
        what: The name of the value, for the error.
        value: Anything.
        minimum: The least that is allowed.
        positive: Whether zero is too little.

    Raises:
        ConfigError: With the name and the value.
    """
    number = number_of(what, value)
    if not math.isfinite(number) or number < minimum or (positive and number <= 0):
        wanted = "positive and finite" if positive else "finite and not negative"
        raise ConfigError(
            f"{what} must be {wanted if positive or minimum == 0 else 'finite'}, got {value!r}"
        )


def number_of(what: str, value: Any) -> float:
    """Turn a value into a float.

    Raises:
        ConfigError: If it is no real number.
    """
    if isinstance(value, Real) or (hasattr(value, "__float__") and np.shape(value) == ()):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            pass
    raise ConfigError(f"{what} must be a number, got {value!r}")


def check_count(what: str, value: Any) -> None:
    """Refuse what is no positive integer.

    Raises:
        ConfigError: With the name and the value.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ConfigError(f"{what} must be a positive integer, got {value!r}")
