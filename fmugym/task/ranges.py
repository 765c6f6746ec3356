"""Ranges of start values, from the config or else from the FMU."""

from __future__ import annotations

import logging
import math
from typing import Any, Final

from fmugym.archive.variable import Variable
from fmugym.distributions import is_distribution, support_of, truncated
from fmugym.errors import ConfigError, shown, warn_once

__all__ = ["within"]

_OF_FMU: Final = (
    "the FMU's min and max (another range: 'bounds', or 'min' and 'max' in a task file)"
)
_GIVEN: Final = "the range that the task gives"

logger = logging.getLogger(__name__)


def within(variable: Variable, value: Any) -> Any:
    """Check that a start value lies in its range, and truncate an unbounded distribution there.

    The log tells once in a process what is truncated.

    Args:
        variable: A scalar or an element of an array, with the bounds of the task.
        value: A checked number or text, or a distribution.

    Returns:
        The value, or a distribution that only draws values in the range.

    Raises:
        ConfigError: If the number or a bounded distribution exceeds the range, or an unbounded one
            hardly ever draws a value in it.
    """
    if variable.kind not in {"real", "integer"}:
        return value
    low, high = variable.bounds or variable.limits
    ends = support_of(value) if is_distribution(value) else (value, value)
    if _lies_in(low, ends[0], high) and _lies_in(low, ends[1], high):
        return value
    if variable.bounds is None and _limits_exclude_start(variable):
        return value
    unit = "" if variable.unit in (None, "", "1") else f" {variable.unit}"
    text = f"{low} and {high}{unit}, {_GIVEN if variable.bounds else _OF_FMU}"
    if all(map(math.isfinite, ends)):
        found = shown(value) if ends[0] == ends[1] else f"{ends[0]} to {ends[1]} of {shown(value)}"
        raise _outside(variable, text, found)
    try:
        own = truncated(value, low, high)
    except ConfigError as error:
        raise _outside(variable, text, error) from None
    warn_once(logger, f"{variable.name!r} is drawn again until it lies between {text}")
    return own


def _limits_exclude_start(variable: Variable) -> bool:
    """Whether the FMU's limits exclude its own start value, so that they cannot be meant."""
    low, high = variable.limits
    try:
        return variable.start is not None and not _lies_in(low, variable.start_number, high)
    except ConfigError:  # no number
        return False


def _lies_in(low: float, value: float, high: float) -> bool:
    """Conversions between units may round a value that is at a limit."""
    return low <= value <= high or math.isclose(value, low) or math.isclose(value, high)


def _outside(variable: Variable, wanted: str, found: object) -> ConfigError:
    return ConfigError(f"{variable.name!r} must lie between {wanted}; got {found}")
