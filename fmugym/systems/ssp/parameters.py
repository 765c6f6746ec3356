"""Parameter sets and their mappings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

from fmugym.archive.description import Unit
from fmugym.archive.units import IDENTITY, Conversion
from fmugym.errors import FMULoadError, shown
from fmugym.systems.ssp.elements import (
    children,
    number_in,
    read_units,
    scaling_of,
    unit_of,
)

__all__ = ["Setting", "read_settings"]

_SET_TYPE: Final = "application/x-ssp-parameter-set"
_MAPPING_TYPE: Final = "application/x-ssp-parameter-mapping"
_NUMERIC: Final = (
    *("Real", "Float64", "Float32", "Integer"),
    *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)),
)
_MAPPINGS: Final = {
    "Boolean": "BooleanMappingTransformation",
    "Integer": "IntegerMappingTransformation",
    "Enumeration": "EnumerationMappingTransformation",
}


@dataclass(frozen=True)
class Setting:
    """A value for a parameter or a start value.

    Attributes:
        name: The hierarchical name, seen from the element that has the binding.
        value: A number, a Boolean, a text, or the name of an item of an enumeration; of an array,
            a tuple of numbers or Booleans in row-major order.
        unit: Unit of a real number; None if the source gives none.
        units: The definitions of units in the source.
        convert: Whether the value is converted to the unit of the parameter.
        scaling: Applied to the converted value.
    """

    name: str
    value: float | bool | str | tuple[float, ...]
    unit: str | None
    units: dict[str, Unit]
    convert: bool = True
    scaling: Conversion = IDENTITY


def read_settings(xml: Any, read: Callable[[str], Any], findings: list[str]) -> Iterator[Setting]:
    """Read the values of a parameter binding.

    Args:
        xml: The element of the binding.
        read: Returns the root of another XML file of the archive by its URI.
        findings: List to which ignored parts are added.

    Raises:
        FMULoadError: If a source or a transformation cannot be used.
    """
    source = _content(xml, "ParameterValues/ParameterSet", read, _SET_TYPE)
    if source is None:
        findings.append(f"line {xml.sourceline}: a parameter binding has no values")
        return
    units, prefix = read_units(source), xml.get("prefix") or ""
    settings = [
        setting
        for one in children(source, "Parameters/Parameter")
        if (setting := _setting(one, prefix, units, findings))
    ]
    mapping = next(children(xml, "ParameterMapping"), None)
    if mapping is None:
        yield from settings
        return
    entries = _content(mapping, "ParameterMapping", read, _MAPPING_TYPE)
    yield from _mapped(settings, mapping if entries is None else entries)


def _content(xml: Any, inline: str, read: Callable[[str], Any], kind: str) -> Any:
    """The root of an external file, or the element that is there in its place."""
    if xml.get("type") not in (None, kind):
        raise FMULoadError(
            f"line {xml.sourceline}: parameters of type {shown(xml.get('type'))} are not supported"
        )
    source = xml.get("source")
    if not source:
        return next(children(xml, inline), None)
    if xml.get("sourceBase") == "component":
        raise FMULoadError(
            f"line {xml.sourceline}: parameters inside of a component ({shown(source)}) are not "
            "supported; put the file into the archive's resources"
        )
    return read(source)


def _setting(xml: Any, prefix: str, units: dict[str, Unit], findings: list[str]) -> Setting | None:
    name = prefix + (xml.get("name") or "")
    is_array = next(children(xml, "Dimension"), None) is not None
    for element in xml.iterchildren("{*}*"):
        kind = element.tag.rpartition("}")[2]
        if is_array and kind in {*_NUMERIC, "Boolean"}:
            return Setting(name, _numbers(element), unit_of(element), units)
        if is_array and kind in {"String", "Enumeration"}:
            findings.append(f"the parameter {shown(name)} is an array of {kind} and is ignored")
            return None
        if kind in _NUMERIC:
            return Setting(name, number_in(element, "value"), unit_of(element), units)
        if kind == "Boolean":
            return Setting(name, element.get("value") in {"true", "1"}, None, units)
        if kind in {"String", "Enumeration"}:
            return Setting(name, element.get("value") or "", None, units)
        if kind != "Annotations":
            findings.append(f"the parameter {shown(name)} of type {kind} is ignored")
    return None


def _numbers(xml: Any) -> tuple[float, ...]:
    """The values of an array, which are separated by spaces."""
    texts = (xml.get("value") or "").split()
    try:
        numbers = tuple(float({"true": 1, "false": 0}.get(text, text)) for text in texts)
    except ValueError:
        numbers = (math.nan,)
    if not all(map(math.isfinite, numbers)):
        text = shown(xml.get("value"))
        raise FMULoadError(f"line {xml.sourceline}: value is {text}, expected numbers")
    return numbers


def _mapped(settings: list[Setting], mapping: Any) -> Iterator[Setting]:
    """Only parameters that the mapping names are set."""
    by_name = {setting.name: setting for setting in settings}
    for entry in children(mapping, "MappingEntry"):
        setting = by_name.get(entry.get("source") or "")
        if setting is not None:
            convert = entry.get("suppressUnitConversion") not in {"true", "1"}
            yield _transformed(
                replace(setting, name=entry.get("target") or "", convert=convert), entry
            )


def _transformed(setting: Setting, entry: Any) -> Setting:
    for kind, name in _MAPPINGS.items():
        for table in children(entry, name):
            texts = {one.get("source"): one.get("target") for one in children(table, "MapEntry")}
            return replace(setting, value=_looked_up(setting, kind, texts, entry))
    return replace(setting, scaling=scaling_of(entry))


def _looked_up(
    setting: Setting, kind: str, texts: dict[str | None, str | None], entry: Any
) -> float | bool | str:
    key = setting.value
    if isinstance(key, tuple):
        raise FMULoadError(
            f"line {entry.sourceline}: {_MAPPINGS[kind]} is not supported for arrays"
        )
    if kind == "Boolean":
        table = {str(k in {"true", "1"}): v in {"true", "1"} for k, v in texts.items()}
        return table.get(str(bool(key)), key)
    text = f"{key:g}" if isinstance(key, float) else str(key)
    target = texts.get(text)
    if target is None:
        raise FMULoadError(f"line {entry.sourceline}: the mapping has no entry for {shown(text)}")
    return float(target) if kind == "Integer" else target
