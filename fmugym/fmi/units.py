"""Conversions between units."""

from __future__ import annotations

import operator
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, TypeVar

from fmugym.errors import ConfigError, shown
from fmugym.fmi.description import BASE_UNITS, Unit
from fmugym.fmi.variable import Variable

__all__ = [
    "IDENTITY",
    "Conversion",
    "conversion_between",
    "conversion_of",
    "conversion_of_link",
]

_Value = TypeVar("_Value")
"""A number, or an object that calculates like one."""


@dataclass(frozen=True)
class Conversion:
    """A value times ``factor``, plus ``offset``, is the value in the other unit."""

    factor: float = 1.0
    offset: float = 0.0

    def __call__(self, value: _Value) -> _Value:
        """Convert a value to the other unit."""
        if self.factor != 1.0:
            value = operator.mul(value, self.factor)
        return value if self.offset == 0.0 else operator.add(value, self.offset)

    def inverse(self, value: _Value) -> _Value:
        """Convert a value of the other unit back."""
        if self.offset != 0.0:
            value = operator.sub(value, self.offset)
        return value if self.factor == 1.0 else operator.truediv(value, self.factor)

    def after(self, first: Conversion) -> Conversion:
        """The conversion that does another one first."""
        return Conversion(self.factor * first.factor, self(first.offset))

    def of_differences(self, are_meant: bool = True) -> Conversion:
        """The conversion of differences of values, which has no offset.

        Args:
            are_meant: Whether differences are meant; else this is the conversion of values.
        """
        return Conversion(self.factor) if are_meant else self


IDENTITY: Final = Conversion()


def conversion_of(
    variable: Variable, wanted: str | None, definitions: Mapping[str, Unit]
) -> Conversion:
    """Find the conversion from the unit of a variable of the FMU, which may be a difference.

    Args:
        variable: The variable.
        wanted: The unit to convert to; None for the variable's own.
        definitions: The units that the FMU defines.

    Raises:
        ConfigError: If one unit is unknown, or they measure different quantities.
    """
    found = conversion_between(variable.unit, wanted, definitions)
    return found.of_differences(variable.relative)


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
    own, wanted = _meant(own, definitions), _meant(wanted, definitions)
    displays = definitions.get(own, Unit()).display_units
    if wanted in displays:
        return Conversion(*displays[wanted])
    return conversion_of_link(own, definitions, wanted, definitions)


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


def conversion_of_link(
    source: str | None,
    source_units: Mapping[str, Unit],
    target: str | None,
    target_units: Mapping[str, Unit],
) -> Conversion:
    """Find the conversion from a unit of one FMU to a unit of another.

    What both FMUs define comes first: two FMUs may mean different units by one name. Pint knows
    the other units. Without a unit on both sides there is nothing to convert.

    Args:
        source: The unit of the value.
        source_units: The units that its FMU defines.
        target: The unit to convert to.
        target_units: The units that the other FMU defines.

    Raises:
        ConfigError: If one unit is unknown, or they measure different quantities.
    """
    if source is None or target is None:
        return IDENTITY
    source, target = _meant(source, source_units), _meant(target, target_units)
    for dimension, (factor, offset) in _defined(source, source_units):
        for other, (to_base, base_offset) in _defined(target, target_units):
            if dimension is not None and dimension == other:
                return Conversion(factor / to_base, (offset - base_offset) / to_base)
    if source == target:
        return IDENTITY
    return _conversion_by_pint(source, source_units, target, target_units)


def _meant(name: str, definitions: Mapping[str, Unit]) -> str:
    """The name of a unit without brackets, which some tools write: ``[m]``, and ``[-]`` for 1."""
    brackets = re.fullmatch(r"\[([^][]*)\]", name.strip())
    if brackets is None or any(True for _ in _defined(name, definitions)):
        return name
    inside = brackets[1].strip()
    return "1" if inside in {"", "-"} else inside


_LARGE: Final = 2.0**20
"""The factor is taken from a large difference, so that an offset costs it no digits."""


def _conversion_by_pint(
    own: str, own_units: Mapping[str, Unit], wanted: str, wanted_units: Mapping[str, Unit]
) -> Conversion:
    (source, before), (target, after) = _known(own, own_units), _known(wanted, wanted_units)
    pint, registry = _pint()
    try:
        zero, large = (
            float(registry.Quantity(value, source).to(target).magnitude) for value in (0.0, _LARGE)
        )
    except pint.DimensionalityError:
        raise ConfigError(
            f"the unit {shown(wanted)} does not measure what the unit {shown(own)} measures"
        ) from None
    factor = (large - zero) / _LARGE
    offset = after.inverse(factor * before.offset + zero)
    return Conversion(before.factor * factor / after.factor, offset)


def _known(name: str, definitions: Mapping[str, Unit]) -> tuple[Any, Conversion]:
    """A unit of pint and the conversion to it; SI units define a unit that pint does not know."""
    try:
        return _parsed(name), IDENTITY
    except ConfigError:
        known = ((powers, linear) for powers, linear in _defined(name, definitions) if powers)
        found = next(known, None)
        if found is None:
            raise
    powers = zip(BASE_UNITS, found[0], strict=True)
    base = "*".join(f"{symbol}**({power})" for symbol, power in powers)
    return _parsed(base), Conversion(*found[1])


@cache
def _pint() -> tuple[Any, Any]:
    """Pint and its table of units, which takes a third of a second to read."""
    import pint

    return pint, pint.UnitRegistry(on_redefinition="ignore")


_EXPONENT: Final = re.compile(r"\*\*\s*(\(\s*)?[-+]?\d{1,3}([./]\d{1,3})?(?(1)\s*\))(?!\s*\*\*)")
_HARMLESS: Final = re.compile(r"(?!.*\*\*)(\b[^\W\d]\w*\b|\b1\b|\W){0,200}")
"""Names and ones, besides exponents: pint would compute powers of numbers, of any size."""


def _parsed(name: str) -> Any:
    """Parse a unit as Modelica and FMI write it, where ``.`` multiplies: ``W/(m2.K)``."""
    text = re.sub(r"(?<=[A-Za-z%])(-?\d+)", r"**(\1)", name.replace(".", "*"))
    text = re.sub(r"(?<=[\w)])\^", "**", text).replace("%", "percent")
    try:
        if not _HARMLESS.fullmatch(_EXPONENT.sub(" ", text)):
            raise ValueError(text)
        return _pint()[1].Unit(text)
    except Exception as error:  # pint passes on errors of the parsers that it uses
        raise ConfigError(
            f"{shown(name)} is no unit that is known; write units as FMI ('W/(m2.K)') or Pint does"
        ) from error
