"""Elements of a SystemStructure.ssd file, with parameter sets and their mappings, as data.

The standard: Modelica Association, System Structure and Parameterization 1.0, 2019.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

from fmugym.errors import FMULoadError, shown
from fmugym.fmi.description import BASE_UNITS, Unit
from fmugym.fmi.units import IDENTITY, Conversion

__all__ = [
    "SSD",
    "Element",
    "OwnConnector",
    "Setting",
    "SystemElement",
    "Wire",
    "children",
    "ignored",
    "number_in",
    "read_settings",
    "read_system",
    "read_units",
    "scaling_of",
    "unit_of",
]

SSD: Final = "SystemStructure.ssd"
"""The file of an archive that describes its system."""

_FMU_TYPE: Final = "application/x-fmu-sharedlibrary"

_GIVES: Final = {"output", "calculatedParameter", "local", "constant"}
_INTERFACES: Final = {
    None: None,
    "any": None,
    "CoSimulation": "co_simulation",
    "ModelExchange": "model_exchange",
}
_REALS: Final = ("Real", "Float64", "Float32")
_IGNORED: Final = {
    "ElementGeometry",
    "SystemGeometry",
    "GraphicalElements",
    "ConnectorGeometry",
    "ConnectionGeometry",
}
_MAPPINGS: Final = (
    *("BooleanMappingTransformation", "IntegerMappingTransformation"),
    "EnumerationMappingTransformation",
)


@dataclass(frozen=True)
class OwnConnector:
    """A connector of an element.

    Attributes:
        kind: ``"input"``, ``"output"``, ``"parameter"`` or another of the standard's.
        unit: None where the file gives none.
    """

    kind: str
    unit: str | None

    @property
    def gives(self) -> bool:
        """Whether values flow out of the element by it."""
        return self.kind in _GIVES


@dataclass
class Element:
    """A component.

    Attributes:
        name: In its system.
        connectors: By name.
        bindings: The XML elements of the parameter bindings in their order, which
            ``fmugym.fmi.systems.ssp_elements`` reads.
        source: The URI of the FMU.
        interface: One of fmugym's; None for any.
    """

    name: str
    connectors: dict[str, OwnConnector]
    bindings: list[Any]
    source: str
    interface: str | None


@dataclass(frozen=True)
class Wire:
    """A connection, as the file has it: its ends say nothing about the direction.

    Attributes:
        start, end: The name of an element, or None for the system itself, and of its connector.
        scaling: The linear transformation, applied after the conversion of units.
        convert: Whether units are converted.
    """

    start: tuple[str | None, str]
    end: tuple[str | None, str]
    scaling: Conversion
    convert: bool

    def __str__(self) -> str:
        return " - ".join(".".join(filter(None, end)) for end in (self.start, self.end))


@dataclass
class SystemElement:
    """A system and its elements.

    Attributes:
        name, connectors, bindings: See ``Element``.
        elements: The components and systems by name.
        wires: The connections.
        description: For people.
    """

    name: str
    connectors: dict[str, OwnConnector]
    bindings: list[Any]
    elements: dict[str, Element | SystemElement]
    wires: list[Wire]
    description: str


def children(xml: Any, path: str) -> Iterator[Any]:
    """Find elements by names without their namespaces, which differ between drafts of SSP."""
    return iter(xml.iterfind("/".join(f"{{*}}{name}" for name in path.split("/"))))


def number_in(xml: Any, attribute: str, default: float = 0.0) -> float:
    """Read a finite number.

    Raises:
        FMULoadError: If the attribute is something else.
    """
    text = xml.get(attribute)
    try:
        number = default if text is None else float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise FMULoadError(
            f"line {xml.sourceline}: {attribute} is {shown(text)}, expected a number"
        )
    return number


def read_system(xml: Any, findings: list[str]) -> SystemElement:
    """Read a system with all that is in it.

    Args:
        xml: The element ``System``.
        findings: List to which ignored parts are added.

    Raises:
        FMULoadError: If it has something that would change results and cannot be used.
    """
    for place in ("SignalDictionaries/SignalDictionary", "Elements/SignalDictionaryReference"):
        for element in children(xml, place):
            raise FMULoadError(
                f"line {element.sourceline}: signal dictionaries are not supported; connect the "
                f"components of {shown(xml.get('name'))} directly"
            )
    elements: dict[str, Element | SystemElement] = {}
    for element in children(xml, "Elements/*"):
        kind = element.tag.rpartition("}")[2]
        if kind not in {"Component", "System"}:
            continue
        name = element.get("name") or ""
        if name in elements or not name:
            raise FMULoadError(
                f"line {element.sourceline}: {shown(name)} is no new name of an element"
            )
        read = _read_component if kind == "Component" else read_system
        elements[name] = read(element, findings)
    return SystemElement(
        name=xml.get("name") or "system",
        connectors=_read_connectors(xml),
        bindings=list(children(xml, "ParameterBindings/ParameterBinding")),
        elements=elements,
        wires=[_read_wire(one) for one in children(xml, "Connections/Connection")],
        description=xml.get("description") or "",
    )


def ignored(root: Any) -> list[str]:
    """Describe the parts of a file that have no effect: annotations and geometry."""
    types = Counter(one.get("type") for one in root.iter("{*}Annotation"))
    shapes = Counter(one.tag.rpartition("}")[2] for one in root.iter("{*}*"))
    return [
        *(f"{n} annotations of type {shown(kind)} are ignored" for kind, n in types.items()),
        *(f"{shapes[name]} elements {name} are ignored" for name in sorted(_IGNORED & set(shapes))),
    ]


def _read_component(xml: Any, findings: list[str]) -> Element:
    name, kind = xml.get("name"), xml.get("type") or _FMU_TYPE
    if kind != _FMU_TYPE:
        raise FMULoadError(
            f"line {xml.sourceline}: the component {shown(name)} is of type {shown(kind)}, "
            f"expected {_FMU_TYPE!r}"
        )
    wanted = xml.get("implementation")
    if wanted not in _INTERFACES:
        findings.append(f"implementation {shown(wanted)} of {shown(name)} is taken for 'any'")
    return Element(
        name=name,
        connectors=_read_connectors(xml),
        bindings=list(children(xml, "ParameterBindings/ParameterBinding")),
        source=xml.get("source") or "",
        interface=_INTERFACES.get(wanted),
    )


def _read_connectors(xml: Any) -> dict[str, OwnConnector]:
    found = {}
    for one in children(xml, "Connectors/Connector"):
        found_types = (next(children(one, name), None) for name in _REALS)
        real = next((element for element in found_types if element is not None), None)
        unit = None if real is None else unit_of(real)
        kind = one.get("kind") or one.get("causality")  # as drafts of 2015 call it
        found[one.get("name") or ""] = OwnConnector(kind or "", unit or unit_of(one))
    return found


def _read_wire(xml: Any) -> Wire:
    ends = [
        (xml.get(f"{end}Element") or None, xml.get(f"{end}Connector") or "")
        for end in ("start", "end")
    ]
    suppressed = xml.get("suppressUnitConversion") in {"true", "1"}
    return Wire(ends[0], ends[1], scaling_of(xml), not suppressed)


def scaling_of(xml: Any) -> Conversion:
    """Read the linear transformation of a connection or of an entry of a mapping.

    Raises:
        FMULoadError: If it has another transformation.
    """
    for name in _MAPPINGS:
        for other in children(xml, name):
            raise FMULoadError(f"line {other.sourceline}: {name} is not supported here")
    for linear in children(xml, "LinearTransformation"):
        return Conversion(number_in(linear, "factor", 1.0), number_in(linear, "offset"))
    return IDENTITY


def unit_of(xml: Any) -> str | None:
    """Unit of a number; tools write an empty one for none."""
    return xml.get("unit") or None


def read_units(xml: Any) -> dict[str, Unit]:
    """Read the definitions of units of a file.

    Raises:
        FMULoadError: If a number is none, or a factor is 0.
    """
    units = {}
    for one in children(xml, "Units/Unit"):
        for base in children(one, "BaseUnit"):
            dimension = tuple(round(number_in(base, name)) for name in BASE_UNITS)
            factor, offset = number_in(base, "factor", 1.0), number_in(base, "offset")
            if factor == 0.0:
                raise FMULoadError(
                    f"line {base.sourceline}: factor of the unit {shown(one.get('name'))} is 0, "
                    "expected another number"
                )
            units[one.get("name") or ""] = Unit(dimension, factor, offset)
    return units


_SET_TYPE: Final = "application/x-ssp-parameter-set"
_MAPPING_TYPE: Final = "application/x-ssp-parameter-mapping"
_NUMERIC: Final = (
    *("Real", "Float64", "Float32", "Integer"),
    *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)),
)
_SET_MAPPINGS: Final = {
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
    for kind, name in _SET_MAPPINGS.items():
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
            f"line {entry.sourceline}: {_SET_MAPPINGS[kind]} is not supported for arrays"
        )
    if kind == "Boolean":
        table = {str(k in {"true", "1"}): v in {"true", "1"} for k, v in texts.items()}
        return table.get(str(bool(key)), key)
    text = f"{key:g}" if isinstance(key, float) else str(key)
    target = texts.get(text)
    if target is None:
        raise FMULoadError(f"line {entry.sourceline}: the mapping has no entry for {shown(text)}")
    return float(target) if kind == "Integer" else target
