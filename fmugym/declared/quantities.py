"""Durations such as ``"15min"``, and conversions between units."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from fmugym.archive.description import Unit
from fmugym.checks import check_number
from fmugym.errors import ConfigError, shown

__all__ = ["IDENTITY", "Conversion", "conversion_between", "duration"]

_SECONDS: Final = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
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
    total, place = 0.0, 0
    while match := _PART.match(value, place):
        total, place = total + float(match[1]) * _SECONDS[match[2]], match.end()
    if not place or value[place:].strip() or not math.isfinite(total):
        raise ConfigError(
            f"{what} must be a number of seconds, or a text such as '15min' or '1h 30min' "
            f"(units: {', '.join(_SECONDS)}), got {shown(value)}"
        )
    return total


@dataclass(frozen=True)
class Conversion:
    """A value of the FMU times ``factor``, plus ``offset``, is the value of the task."""

    factor: float = 1.0
    offset: float = 0.0

    def __call__(self, value: float) -> float:
        """Convert a value of the FMU to the unit of the task."""
        return value * self.factor + self.offset

    def inverse(self, value: float) -> float:
        """Convert a value of the task to the unit of the FMU."""
        return (value - self.offset) / self.factor


IDENTITY: Final = Conversion()


def conversion_between(
    own: str | None, wanted: str | None, definitions: Mapping[str, Unit]
) -> Conversion:
    """Find the conversion from a variable's unit to the one that a task asks for.

    The FMU's own definitions come first, since it says by them what it means by a name. Pint knows
    the other units.

    Args:
        own: The unit of the variable in the FMU; None if the FMU gives none. The wanted unit is
            then taken to be the variable's own.
        wanted: The unit that the task asks for; None for the variable's own.
        definitions: The units that the FMU defines.

    Raises:
        ConfigError: If one unit is unknown, or they measure different quantities.
    """
    if wanted is None or own is None or wanted == own:
        return IDENTITY
    own_unit = definitions.get(own, Unit())
    if wanted in own_unit.display_units:
        return Conversion(*own_unit.display_units[wanted])
    for dimension, to_base in _defined(wanted, definitions):
        if dimension is not None and dimension == own_unit.dimension:
            factor, offset = to_base
            return Conversion(own_unit.factor / factor, (own_unit.offset - offset) / factor)
    return _conversion_by_pint(own, wanted)


def _defined(
    name: str, definitions: Mapping[str, Unit]
) -> Iterator[tuple[tuple[int, ...] | None, tuple[float, float]]]:
    """The definitions of a name: the dimension, and factor and offset to its SI unit."""
    if name in definitions:
        unit = definitions[name]
        yield unit.dimension, (unit.factor, unit.offset)
    for unit in definitions.values():
        if name in unit.display_units:
            factor, offset = unit.display_units[name]
            yield (
                unit.dimension,
                (unit.factor / factor, unit.offset - unit.factor * offset / factor),
            )


_LARGE: Final = 2.0**20
"""The factor is taken from a large difference, so that an offset costs it no digits."""


def _conversion_by_pint(own: str, wanted: str) -> Conversion:
    pint, registry = _pint()
    source, target = _parsed(own), _parsed(wanted)
    try:
        zero, large = (
            float(registry.Quantity(value, source).to(target).magnitude) for value in (0.0, _LARGE)
        )
    except pint.DimensionalityError:
        raise ConfigError(
            f"the unit {shown(wanted)} does not measure what the FMU's unit {shown(own)} measures"
        ) from None
    return Conversion((large - zero) / _LARGE, zero)


@cache
def _pint() -> tuple[Any, Any]:
    """Pint and its table of units, which takes a third of a second to read."""
    import pint

    return pint, pint.UnitRegistry(on_redefinition="ignore")


def _parsed(name: str) -> Any:
    """A unit in the way of writing of Modelica and FMI, where ``.`` multiplies: ``W/(m2.K)``."""
    text = re.sub(r"(?<=[A-Za-z%])(-?\d+)", r"**(\1)", name.replace(".", "*"))
    text = re.sub(r"(?<=[\w)])\^", "**", text).replace("%", "percent")
    try:
        return _pint()[1].Unit(text)
    except Exception as error:  # pint passes on errors of the parsers that it uses
        raise ConfigError(
            f"{shown(name)} is no unit that is known ({type(error).__name__})"
        ) from None
