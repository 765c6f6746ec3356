"""Guesses of the units of variables to which the FMU gives no unit."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from fmugym.environment.episode import Quantity
from fmugym.errors import ConfigError
from fmugym.fmi.description import ModelDescription, Unit
from fmugym.fmi.units import IDENTITY, Conversion, conversion_of
from fmugym.fmi.variable import Variable

__all__ = [
    "Misreading",
    "finite_values",
    "likely_unit",
    "likely_units",
    "misreadings",
    "require_units",
    "unit_within",
]

_UNITS: Final[Mapping[str, tuple[str, ...]]] = {
    "K": ("K", "degC", "degF", "celsius", "kelvin"),
    "Pa": ("Pa", "hPa", "kPa", "MPa", "bar", "mbar"),
    "%": ("%", "1", "percent"),
}
"""Units of the quantities that are known by their values, by the one that surprises."""

_WORDS: Final[Mapping[str, str]] = {
    "K": r"T|temp\w*|T(air|amb|ext|in|out|ret|room|roo|set|start|sup|wall|wat|water|zone|zon)\w*",
    "Pa": r"p|dp|pres|press\w*|p(in|out|amb|atm|set|start)\w*",
    "%": r"rh|humid\w*|valve\w*|damper\w*|opening\w*|soc|percent\w*",
}
"""Words in names that tell such a quantity."""

_SAID: Final[Mapping[str, str]] = {
    "K": r"\b[Kk]elvin\b|[\[(]K[\])]|\bin K\b",
    "degC": r"\b[Cc]elsius\b|\bdeg ?C\b|°C|[\[(]C[\])]",
    "Pa": r"\b[Pp]ascals?\b|[\[(]Pa[\])]|\bin Pa\b",
    "%": r"\b[Pp]er ?cent\b|%|\bpct\b",
}
"""Units in descriptions."""

_DESCRIBED: Final[Mapping[str, str]] = {
    "K": r"\b[Tt]emperature\b",
    "Pa": r"\b[Pp]ressure\b",
    "%": r"\b[Hh]umidity\b",
}
"""Quantities in descriptions."""

_USUAL: Final[Mapping[str, tuple[float, float]]] = {
    "K": (200.0, 500.0),
    "Pa": (5e3, 1e9),
    "%": (0.0, 100.0),
}
"""The values that such variables have."""

_MOST_OF_A_SHARE: Final = 1.5
"""Values above this are per cent, where a share is at most 1."""

_CANDIDATES: Final = (
    *("K", "degC", "Pa", "%", "1", "W", "J", "m", "m/s", "m3/s", "kg/s", "rad", "rad/s"),
    *("degF", "bar", "kPa", "hPa", "kW", "kWh", "deg", "rpm", "h", "min"),
)
"""Units that an FMU may mean, the most likely first."""


def likely_units(description: ModelDescription) -> dict[str, str]:
    """Guess units from descriptions, for inputs, outputs and locals without one, by name.

    A temperature without a start value is in kelvin where others of the FMU are.
    """
    variables = [v for v in description.variables.values() if v.unit is None]
    found = {variable.name: likely_unit(variable) for variable in variables}
    if "K" in found.values() and not any(map(_is_of_celsius, variables)):
        found |= {v.name: "K" for v in variables if _may_be_kelvin(v)}
    used = {v.name for v in variables if v.causality in {"input", "output", "local"}}
    return {name: unit for name, unit in found.items() if unit is not None and name in used}


def _may_be_kelvin(variable: Variable) -> bool:
    """Whether a variable is a temperature by its name or description, and has no start value."""
    is_number = variable.kind == "real" and not variable.relative
    is_number &= not variable.name.rpartition(".")[2].startswith("der")
    is_open = not _start_values(variable) and _said(variable) in (None, "K")
    return is_number and is_open and _is_called(variable, "K", None)


def _is_of_celsius(variable: Variable) -> bool:
    """Whether a temperature starts as one in degrees Celsius does."""
    starts = _start_values(variable)
    is_usual = any(0.0 < abs(value) < _MOST_CELSIUS for value in starts)
    return is_usual and variable.kind == "real" and _is_called(variable, "K", None)


_MOST_CELSIUS: Final = 100.0


def likely_unit(
    variable: Variable, values: Sequence[float] = (), wanted: str | None = None
) -> str | None:
    """The unit that a variable without one probably has.

    Args:
        variable: The variable.
        values: Values that it had; by default its start value.
        wanted: The unit that a task takes it for, which tells the quantity.

    Returns:
        ``"K"``, ``"degC"``, ``"Pa"`` or ``"%"``; None if nothing tells.
    """
    if variable.unit is not None or variable.kind != "real" or variable.relative:
        return None
    known = list(values) or _start_values(variable)
    said = _said(variable)
    if said is not None:
        return said if said == "degC" or _is_usual(said, known, default=True) else None
    if not known:
        return None
    for unit in _UNITS:
        if _is_called(variable, unit, wanted) and _is_usual(unit, known, default=False):
            return unit
    return "K" if all(map(_is_from_celsius, known)) else None


def _said(variable: Variable) -> str | None:
    """The unit that the description tells."""
    for unit, pattern in _SAID.items():
        if re.search(pattern, variable.description):
            return unit
    return None


def _start_values(variable: Variable) -> list[float]:
    """The start value of a scalar; none if there is no number."""
    with suppress(ConfigError):
        if variable.start is not None and not variable.shape:
            return [variable.start_number]
    return []


def _is_called(variable: Variable, unit: str, wanted: str | None) -> bool:
    if wanted is not None:
        return wanted in _UNITS[unit]
    if re.search(_DESCRIBED[unit], variable.description):
        return True
    last = variable.name.rpartition(".")[2]
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", last)
    words += [word.lower() for word in words if len(word) > 1]  # T is not t, p is not P
    return any(re.fullmatch(_WORDS[unit], word) for word in words)


def _is_usual(unit: str, values: Iterable[float], *, default: bool) -> bool:
    low, high = _USUAL[unit]
    known = list(values)
    if unit == "%" and known and max(known) <= _MOST_OF_A_SHARE:
        return False
    return all(low <= value <= high for value in known) if known else default


def _is_from_celsius(value: float) -> bool:
    """Whether a value is a multiple of half a degree Celsius, in kelvin."""
    low, high = _USUAL["K"]
    halves = 2.0 * (value - 273.15)
    return low <= value <= high and abs(halves - round(halves)) < 1e-6


def unit_within(
    variable: Variable,
    wanted: str,
    limits: tuple[float, float],
    seen: tuple[float, float],
    definitions: Mapping[str, Unit],
) -> str | None:
    """The unit that brings values within limits which they contradict.

    Args:
        variable: A variable to which the FMU gives no unit.
        wanted: The unit of the task.
        limits: Its limits in this unit; infinite where there are none.
        seen: The lowest and the highest value, as the FMU gives them.
        definitions: The units that the FMU defines.

    Returns:
        None if the values do not contradict the limits, or no unit explains it.
    """
    if _lie_within(seen, limits):
        return None
    for unit in _CANDIDATES:
        with suppress(ConfigError):
            meant = replace(variable, unit=unit)
            conversion = conversion_of(meant, wanted, definitions)
            if conversion != IDENTITY and _explains(conversion, limits, seen):
                return unit
    return None


def _explains(
    conversion: Conversion, limits: tuple[float, float], seen: tuple[float, float]
) -> bool:
    """Whether values lie within limits once converted, and are far from them before.

    Far away in the sense of the conversion: the limits are nearer to the converted values.
    """
    first, second = sorted(map(conversion, seen))
    if not _lie_within((first, second), limits):
        return False
    if conversion.offset:
        return seen[0] > limits[1] or seen[1] < limits[0]
    largest = max(map(abs, seen))
    bound = max((abs(one) for one in limits if math.isfinite(one)), default=0.0)
    factor = abs(conversion.factor)
    return bound > 0.0 and largest / bound >= math.sqrt(max(factor, 1 / factor))


def _lie_within(seen: tuple[float, float], limits: tuple[float, float]) -> bool:
    span = limits[1] - limits[0]
    margin = 0.1 * span if math.isfinite(span) else 0.0
    return limits[0] - margin <= seen[0] and seen[1] <= limits[1] + margin


@dataclass(frozen=True)
class Misreading:
    """Suspicion that the FMU means a variable in another unit than the task.

    Attributes:
        name: Its name in the task.
        text: Description of the reason.
        line: Line for ``[variables]``.
        contradicts: Whether its values contradict its limits in the task.
        is_converted: Whether the task takes it for a unit.
    """

    name: str
    text: str
    line: str
    contradicts: bool = False
    is_converted: bool = True


def misreadings(env: Any, seen: Mapping[str, Sequence[float]]) -> Iterator[Misreading]:
    """Find the variables of a declared task that the FMU seems to mean in another unit.

    Args:
        env: The environment of the task.
        seen: Finite values of outputs by the names of the task, in its units.
    """
    given = env.task.document.get("variables") or {}
    for quantity in env.resolved.quantities().all:
        declared = given.get(quantity.name, {})
        variable = _without_unit(env, declared.get("name", quantity.name))
        if quantity.kind not in _KINDS or variable is None or declared.get("sample") == "integral":
            continue
        values = seen.get(quantity.name, ()) if quantity.kind == "output" else ()
        has_limits = not declared.keys().isdisjoint({"min", "max"})
        line = f"{quantity.name} = {{ {'..., ' if declared else ''}fmu_unit = {{}} }}"
        unit, found = declared.get("unit"), None
        if has_limits:
            found = _contradiction(env, quantity, variable, values, unit, line)
        found = found or _surprise(quantity.name, variable, values, unit, line)
        if found is not None:
            yield found
    for name, entry in (env.task.document.get("data") or {}).items():
        to = entry.get("input") or ""
        variable = _without_unit(env, given.get(to, {}).get("name", to))
        if variable is not None and entry.get("unit") is not None:
            line = f'{to}_in = {{ name = "{variable.name}", fmu_unit = {{}} }}'
            found = _surprise(name, variable, (), entry["unit"], line)
            if found is not None:
                yield found


def require_units(env: Any) -> None:
    """Refuse a task whose outputs at the start of an episode contradict their limits.

    Args:
        env: An environment; it is reset if the FMU leaves the unit of such an output open.

    Raises:
        ConfigError: If another unit of the FMU would explain it; the text says which.
    """
    if getattr(env, "task", None) is None or not any(_open_names(env)):
        return
    env.reset(seed=0)
    quantities = env.resolved.quantities()
    pairs = zip(quantities.all, quantities.read(env), strict=True)
    seen = {one.name: finite_values([value]) for one, value in pairs}
    for one in misreadings(env, seen):
        if one.contradicts:
            raise ConfigError(f"{one.text}: write {one.line} under [variables]")


def _open_names(env: Any) -> Iterator[str]:
    """The names of variables with a unit and limits in the task, and no unit in the FMU."""
    for name, declared in (env.task.document.get("variables") or {}).items():
        has_limits = "unit" in declared and not declared.keys().isdisjoint({"min", "max"})
        if has_limits and _without_unit(env, declared.get("name", name)) is not None:
            yield name


def finite_values(values: Iterable[Any]) -> list[float]:
    """The finite numbers among numbers and arrays."""
    numbers = [float(number) for value in values for number in np.ravel(value)]
    return [number for number in numbers if math.isfinite(number)]


_KINDS: Final = ("action", "input", "output", "parameter")


def _without_unit(env: Any, name: str) -> Variable | None:
    """A variable of the FMU; None if it has a unit, or there is none."""
    variable: Variable | None = env.fmu.description.find(name)
    return None if variable is None or variable.unit is not None else variable


def _contradiction(
    env: Any,
    quantity: Quantity,
    variable: Variable,
    values: Sequence[float],
    wanted: str | None,
    line: str,
) -> Misreading | None:
    """Values of an output that are outside of its limits, but would not be in another unit."""
    if not values or wanted is None:
        return None
    seen, limits = (min(values), max(values)), (quantity.low, quantity.high)
    unit = unit_within(variable, wanted, limits, seen, env.fmu.description.units)
    if unit is None:
        return None
    text = (
        f"{quantity.name} is {seen[0]:.4g} to {seen[1]:.4g}, outside of its limits "
        f"{limits[0]:g} and {limits[1]:g} {wanted}; it is within them if the FMU, which "
        f"gives no unit, means {unit}"
    )
    return Misreading(quantity.name, text, _filled(line, unit), contradicts=True)


def _surprise(
    name: str, variable: Variable, values: Sequence[float], wanted: str | None, line: str
) -> Misreading | None:
    """Describe a variable whose values look as if they were in another unit."""
    unit = likely_unit(variable, values, wanted)
    if unit is None or unit == wanted:
        return None
    known = list(values) or _start_values(variable)
    ends = f"{min(known):.4g} to {max(known):.4g}" if known else variable.description
    taken = "" if wanted is None else f"; the task takes it for {wanted}"
    text = f"{name} ({ends}) looks like {unit}, but the FMU gives it no unit{taken}"
    return Misreading(name, text, _filled(line, unit), is_converted=wanted is not None)


def _filled(line: str, unit: str) -> str:
    return line.replace("{}", f'"{unit}"')
