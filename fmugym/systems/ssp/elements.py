"""Elements of a SystemStructure.ssd file, as data."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from fmugym.archive.description import BASE_UNITS, Unit
from fmugym.archive.units import IDENTITY, Conversion
from fmugym.errors import FMULoadError, shown

__all__ = [
    "SSD",
    "Element",
    "OwnConnector",
    "SystemElement",
    "Wire",
    "children",
    "ignored",
    "number_in",
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
            ``fmugym.systems.ssp.parameters`` reads.
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
