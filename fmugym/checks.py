"""Checks of arguments, with errors that name the argument and the expected range."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any, cast

import numpy as np

from fmugym.errors import ConfigError, shown

__all__ = [
    "as_float",
    "check_count",
    "check_number",
    "flag",
    "mapping",
    "number",
    "number_of",
    "text",
    "whole_number",
]


def as_float(value: Any) -> float:
    """Return a real number as a float, and NaN for everything else.

    Args:
        value: Any object. Texts and arrays are not numbers; integers too large are infinite.
    """
    if not isinstance(value, Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf if cast(int, value) > 0 else -math.inf
    except (TypeError, ValueError):  # numpy's time spans count as integers
        return math.nan


def number(
    what: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    may_be_infinite: bool = False,
    positive: bool = False,
) -> float:
    """Return a number as a float.

    Args:
        what: What the number is, for the error.
        value: A real number; texts and arrays are refused.
        low: The lowest value allowed.
        high: The highest value allowed.
        may_be_infinite: Whether infinity is allowed.
        positive: Whether 0 and negative numbers are refused.

    Raises:
        ConfigError: If the value is not a number, is NaN or is out of its range.
    """
    result = as_float(value)
    is_allowed = may_be_infinite or math.isfinite(result)
    if not (is_allowed and low <= result <= high) or (positive and result <= 0.0):
        kind = "number" if may_be_infinite else "finite number"
        wanted = _range(low, high, positive)
        raise ConfigError(f"{what} must be a {kind}{wanted}, not {shown(value)}")
    return result


def whole_number(what: str, value: Any, low: int, high: int) -> int:
    """Return an integer.

    Args:
        what: What the number is, for the error.
        value: An integer of Python or numpy.
        low: The lowest value allowed.
        high: The highest value allowed.

    Raises:
        ConfigError: If the value is not an integer or is out of its range.
    """
    is_integer = isinstance(value, Integral) and not isinstance(value, bool | np.timedelta64)
    if not (is_integer and low <= int(value) <= high):
        raise ConfigError(f"{what} must be an integer from {low} to {high}, not {shown(value)}")
    return int(value)


def flag(what: str, value: Any) -> bool:
    """Return a truth value.

    Raises:
        ConfigError: If the value is neither True nor False.
    """
    if not isinstance(value, bool | np.bool_):
        raise ConfigError(f"{what} must be True or False, not {shown(value)}")
    return bool(value)


def text(what: str, value: Any) -> str:
    """Return a text.

    Raises:
        ConfigError: If the value is not a text.
    """
    if not isinstance(value, str):
        raise ConfigError(f"{what} must be a text, not {shown(value)}")
    return str.__str__(value)  # a subclass may compare in its own way


def mapping(what: str, value: Any) -> dict[Any, Any]:
    """Return a copy of a mapping.

    Raises:
        ConfigError: If the value is not a mapping.
    """
    if not isinstance(value, Mapping):
        raise ConfigError(f"{what} must be a dict, not {shown(value)}")
    return dict(value)


def check_number(
    what: str, value: Any, minimum: float = -math.inf, *, positive: bool = False
) -> None:
    """Check that a value is a finite number in its range.

    Args:
        what: The name of the value, for the error.
        value: Any object.
        minimum: The lowest number allowed.
        positive: Whether 0 is refused too.

    Raises:
        ConfigError: If it is not.
    """
    result = number_of(what, value)
    if not math.isfinite(result) or result < minimum or (positive and result <= 0):
        wanted = "positive and finite" if positive else "finite and not negative"
        raise ConfigError(
            f"{what} must be {wanted if positive or minimum == 0 else 'finite'}, got {shown(value)}"
        )


def number_of(what: str, value: Any) -> float:
    """Turn a value into a float.

    Raises:
        ConfigError: If it is not a real number.
    """
    if isinstance(value, Real) or (hasattr(value, "__float__") and np.shape(value) == ()):
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            pass
    raise ConfigError(f"{what} must be a number, got {shown(value)}")


def check_count(what: str, value: Any) -> None:
    """Check that a value is a positive integer.

    Raises:
        ConfigError: If it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ConfigError(f"{what} must be a positive integer, got {shown(value)}")


def _range(low: float, high: float, positive: bool) -> str:
    if math.isinf(low) and math.isinf(high):
        return " above 0" if positive else ""
    if math.isinf(high):
        return f" of at least {low:g}"
    return f" above 0 and up to {high:g}" if positive else f" from {low:g} to {high:g}"
