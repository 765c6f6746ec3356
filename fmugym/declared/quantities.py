"""Durations such as ``"15min"``."""

from __future__ import annotations

import math
import re
from typing import Any, Final

from fmugym.checks import check_number
from fmugym.errors import ConfigError, shown

__all__ = ["duration"]

_SECONDS: Final = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_NEGATIVE: Final = re.compile(r"\s*-\s*\d")
_PART: Final = re.compile(r"\s*(\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)\s*(ms|s|min|h|d)(?![A-Za-z])")


def duration(what: str, value: Any) -> float:
    """Return a duration in seconds.

    Args:
        what: Its name, for the error.
        value: A number of seconds, or a text such as ``"15min"``, ``"0.02s"`` or ``"1h 30min"``.
            The units are ms, s, min, h and d.

    Raises:
        ConfigError: If it is no duration, or negative.
    """
    if not isinstance(value, str):
        return check_number(what, value, minimum=0)
    if _NEGATIVE.match(value):
        raise ConfigError(f"{what} must not be negative, got {shown(value)}")
    total, place = 0.0, 0
    while match := _PART.match(value, place):
        total, place = total + float(match[1]) * _SECONDS[match[2]], match.end()
    if not place or value[place:].strip() or not math.isfinite(total):
        raise ConfigError(
            f"{what} must be a number of seconds, or a text such as '15min' or '1h 30min' "
            f"(units: {', '.join(_SECONDS)}), got {shown(value)}"
        )
    return total
