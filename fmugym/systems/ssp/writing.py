"""Writing a system as an SSP archive."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from lxml import etree

from fmugym.archive.description import BASE_UNITS, Unit
from fmugym.archive.units import definition_of
from fmugym.archive.variable import Variable
from fmugym.errors import FMULoadError, reason
from fmugym.systems.components import OpenComponent
from fmugym.systems.connections import Connection
from fmugym.systems.plan import Loop
from fmugym.systems.ssp.elements import FMU_TYPE, OWN_ANNOTATION, SSD
from fmugym.systems.wired import LOOPS, WiredSystem

__all__ = ["write_ssp"]

_SPACE: Final = "http://ssp-standard.org/SSP1/SystemStructure"
_SPACES: Final = {
    "ssd": f"{_SPACE}Description",
    "ssc": f"{_SPACE}Common",
    "ssv": f"{_SPACE}ParameterValues",
}
_OWN: Final = "urn:fmugym:system"
_TYPES: Final = {"real": "Real", "integer": "Integer", "boolean": "Boolean", "string": "String"}
_IMPLEMENTATIONS: Final = {
    None: "any",
    "co_simulation": "CoSimulation",
    "model_exchange": "ModelExchange",
}
_DATE: Final = (1980, 1, 1, 0, 0, 0)
"""The date of all files, so that a system is always written as the same bytes."""


def write_ssp(system: WiredSystem, path: Path) -> None:
    """Write a system with its FMUs.

    Args:
        system: The system.
        path: The file, which is replaced if it exists.

    Raises:
        FMULoadError: If the file cannot be written, or an FMU cannot be read.
    """
    sources = _sources(system.components.values())
    text = etree.tostring(
        _document(system, sources), xml_declaration=True, encoding="UTF-8", pretty_print=True
    )
    part = path.with_name(f"{path.name}.part")
    try:
        with zipfile.ZipFile(part, "w") as archive:
            archive.writestr(zipfile.ZipInfo(SSD, _DATE), text, zipfile.ZIP_DEFLATED)
            for fmu, place in sources.items():
                archive.writestr(zipfile.ZipInfo(place, _DATE), fmu.read_bytes())
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise FMULoadError(f"{path} cannot be written: {reason(error)}") from None


def _sources(components: Iterable[OpenComponent]) -> dict[Path, str]:
    """The place in the archive of each FMU; components may share one."""
    places: dict[Path, str] = {}
    for component in components:
        path = component.fmu.path
        if path not in places:
            number = sum(one.stem == path.stem for one in places)
            places[path] = f"resources/{path.stem}{f'_{number + 1}' if number else ''}.fmu"
    return places


def _document(system: WiredSystem, sources: Mapping[Path, str]) -> Any:
    root = etree.Element(_tag("ssd:SystemStructureDescription"), nsmap=_SPACES)
    version = "2.0" if _has_arrays(system) else "1.0"
    root.attrib.update({"version": version, "name": system.name, "generationTool": "fmugym"})
    root.append(_system(system, sources))
    units = dict(_units_of(system))
    if units:
        _add(root, "ssd:Units").extend(_unit(name, unit) for name, unit in units.items())
    times = {"startTime": system.times["start_time"], "stopTime": system.times["stop_time"]}
    _add(root, "ssd:DefaultExperiment", **{k: _text(v) for k, v in times.items() if v is not None})
    return root


def _has_arrays(system: WiredSystem) -> bool:
    """Whether connections or start values are of arrays, which SSP has known since version 2.0."""
    ports = (system.port(end) for one in system.connections for end in (one.source, one.target))
    connected = any(port is not None and not port.variable.is_scalar for port in ports)
    return connected or any(
        not one.variable(name).is_scalar
        for one in system.components.values()
        for name in one.given.start_values
    )


def _system(system: WiredSystem, sources: Mapping[Path, str]) -> Any:
    element = etree.Element(_tag("ssd:System"), name=system.name)
    if system.description:
        element.set("description", system.description)
    if system.connectors:
        connectors = _add(element, "ssd:Connectors")
        for one in system.connectors:
            end = one.ends[0]
            variable = system.components[end.component].variable(end.variable)
            unit = system.units.get(one.name)
            _add_connector(connectors, one.name, one.causality, variable, unit)
    elements = _add(element, "ssd:Elements")
    used = {end for one in system.connections for end in (one.source, one.target)}
    for component in system.components.values():
        elements.append(_component(component, sources[component.fmu.path], used))
    if system.connections:
        connections = _add(element, "ssd:Connections")
        for connection in system.connections:
            _add_connection(connections, system, connection)
    _annotate(element, "Master", _own_of_system(system))
    return element


def _component(component: OpenComponent, source: str, used: set[str]) -> Any:
    element = etree.Element(_tag("ssd:Component"), name=component.name)
    implementation = _IMPLEMENTATIONS[component.fmu.interface]
    element.attrib.update({"type": FMU_TYPE, "source": source, "implementation": implementation})
    shown = [
        one
        for variable in component.fmu.description.variables.values()
        for one in _named_in(used, component.name, variable)
    ]
    if shown:
        connectors = _add(element, "ssd:Connectors")
        for variable in shown:
            _add_connector(connectors, variable.name, _kind(variable), variable)
    if component.given.start_values:
        _add_values(element, component)
    own = {} if component.given.steps == 1 else {"steps": str(component.given.steps)}
    if component.given.feedthrough is False:
        own["feedthrough"] = "false"
    if component.given.isolate:
        own["isolate"] = "true"
    _annotate(element, "Component", own)
    return element


def _named_in(used: set[str], component: str, variable: Variable) -> Iterator[Variable]:
    """A variable and those of its elements that connections name."""
    if f"{component}.{variable.name}" in used:
        yield variable
    begin = f"{component}.{variable.name}["
    if variable.shape and any(name.startswith(begin) for name in used):
        yield from (one for one in variable.elements if f"{component}.{one.name}" in used)


def _kind(variable: Variable) -> str:
    """SSP 1.0 has no connectors of kind local: what gives a value is an output."""
    known = {"input", "output", "parameter", "calculatedParameter"}
    return variable.causality if variable.causality in known else "output"


def _add_connector(
    parent: Any, name: str, kind: str, variable: Variable, unit: str | None = None
) -> None:
    connector = _add(parent, "ssd:Connector", name=name, kind=kind)
    own = _TYPES.get(variable.kind, "Integer")
    found = _add(connector, f"ssc:{own}")
    unit = unit or variable.unit
    if own == "Real" and unit is not None:
        found.set("unit", unit)
    _add_dimensions(connector, variable)


def _add_dimensions(parent: Any, variable: Variable) -> None:
    for length in variable.shape:
        _add(parent, "ssc:Dimension", size=str(length))


def _add_values(element: Any, component: OpenComponent) -> None:
    binding = _add(_add(element, "ssd:ParameterBindings"), "ssd:ParameterBinding")
    values = _add(binding, "ssd:ParameterValues")
    given = {name: component.variable(name) for name in component.given.start_values}
    version = "1.0" if all(variable.is_scalar for variable in given.values()) else "2.0"
    group = _add(values, "ssv:ParameterSet", version=version, name=f"{component.name} values")
    parameters = _add(group, "ssv:Parameters")
    known = {**dict(component.starts), **component.sizes}
    for name, variable in given.items():
        own = _TYPES.get(variable.kind, "Integer")
        parameter = _add(parameters, "ssv:Parameter", name=name)
        texts = [_value(own, known[element.name]) for element in variable.elements]
        _add(parameter, f"ssv:{own}", value=texts[0] if variable.is_scalar else " ".join(texts))
        _add_dimensions(parameter, variable)


def _value(kind: str, value: float | str) -> str:
    if kind == "Boolean":
        return "true" if value else "false"
    if isinstance(value, str):
        return value
    return str(int(value)) if kind == "Integer" else _text(value)


def _text(number: float) -> str:
    """A number with all its digits."""
    return repr(float(number))


def _add_connection(parent: Any, system: WiredSystem, connection: Connection) -> None:
    element = _add(parent, "ssd:Connection")
    for end, name in (("start", connection.source), ("end", connection.target)):
        port = system.port(name)
        if port is not None:
            element.set(f"{end}Element", port.component.name)
        element.set(f"{end}Connector", name if port is None else port.variable.name)
    if not connection.convert_units:
        element.set("suppressUnitConversion", "true")
    if (connection.gain, connection.offset) != (1, 0):
        factor, offset = _text(connection.gain), _text(connection.offset)
        _add(element, "ssc:LinearTransformation", factor=factor, offset=offset)


def _units_of(system: WiredSystem) -> Iterator[tuple[str, Unit]]:
    """The definitions of the units that connectors name, as far as there are any."""
    known: dict[str, Unit] = {}
    for component in system.components.values():
        known = {**component.fmu.description.units, **known}
    known |= system.unit_definitions
    ports = [system.port(end) for one in system.connections for end in (one.source, one.target)]
    names = {port.variable.unit for port in ports if port} | set(system.units.values())
    for name in sorted(name for name in names if name):
        unit = definition_of(name, known)
        if unit is not None:
            yield name, unit


def _unit(name: str, unit: Unit) -> Any:
    element = etree.Element(_tag("ssc:Unit"), name=name)
    base = _add(element, "ssc:BaseUnit")
    for symbol, exponent in zip(BASE_UNITS, unit.dimension or (), strict=True):
        if exponent:
            base.set(symbol, str(exponent))
    if (unit.factor, unit.offset) != (1, 0):
        base.attrib.update({"factor": _text(unit.factor), "offset": _text(unit.offset)})
    return element


def _own_of_system(system: WiredSystem) -> dict[str, str]:
    """How the system is run, as far as it is not the default."""
    default = Loop()
    numbers = {
        "step_size": system.times["step_size"],
        "tolerance": system.times["tolerance"],
        "loop_tolerance": system.loop.tolerance,
        "error_tolerance": None if system.control is None else system.control.tolerance,
        "min_step_size": None if system.control is None else system.control.min_step_size,
    }
    own = {"master": system.master, "loops": system.loops}
    own |= {
        name: _text(value)
        for name, value in numbers.items()
        if value is not None and (name != "loop_tolerance" or value != default.tolerance)
    }
    if system.loop.max_iterations != default.max_iterations:
        own["loop_iterations"] = str(system.loop.max_iterations)
    if own["loops"] == LOOPS[0]:
        del own["loops"]
    return own


def _annotate(element: Any, name: str, own: Mapping[str, str]) -> None:
    if own:
        annotations = _add(element, "ssd:Annotations")
        annotation = _add(annotations, "ssc:Annotation", type=OWN_ANNOTATION)
        etree.SubElement(annotation, f"{{{_OWN}}}{name}", dict(own), nsmap={"fmugym": _OWN})


def _add(parent: Any, tag: str, /, **attributes: str) -> Any:
    return etree.SubElement(parent, _tag(tag), attributes)


def _tag(name: str) -> str:
    prefix, _, local = name.partition(":")
    return f"{{{_SPACES[prefix]}}}{local}"
