"""SSP archive: its reading, and nested systems, flattened to the arguments of an ``FMUSystem``.

Systems are flattened to components, connections between them and start values. A node is a
connector of a component or a system, named by the path of its element and its own name. Connections
make a forest of nodes: every node has one source at most.
"""

from __future__ import annotations

import os
import posixpath
import zipfile
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from fmugym.checks import check_path
from fmugym.errors import ConfigError, FMUGymError, FMULoadError, shown
from fmugym.fmi.description import ModelDescription, Unit
from fmugym.fmi.description_reader import parse_xml, read_xml
from fmugym.fmi.fmu import FMU
from fmugym.fmi.safe_zip import ArchiveLimits, SafeZip
from fmugym.fmi.systems.components import Component, Connection
from fmugym.fmi.systems.ssp_elements import (
    SSD,
    Element,
    OwnConnector,
    Setting,
    SystemElement,
    Wire,
    ignored,
    number_in,
    read_settings,
    read_system,
    read_units,
)
from fmugym.fmi.temporary import folder_name, make_folder
from fmugym.fmi.units import IDENTITY, Conversion, conversion_of_link
from fmugym.fmi.variable import Variable

__all__ = ["Flat", "system_arguments"]

_ElementPath = tuple[str, ...]
_Node = tuple[_ElementPath, str]
"""The path of an element, () for the root system, and the name of a connector."""


@dataclass(frozen=True)
class _Value:
    """A value on its way through connectors: its conversion and its unit; None if unknown.

    ``units`` has the definition of the unit.
    """

    change: Conversion = IDENTITY
    unit: str | None = None
    units: Mapping[str, Unit] = field(default_factory=dict)


@dataclass
class Flat:
    """A tree of systems as one level.

    Args:
        root: The root system.
        units: The units that the file defines.
        description_of: Reads the model description of a component.
        findings: List to which ignored parts are added.

    Attributes:
        components: The components by path.
    """

    root: SystemElement
    units: Mapping[str, Unit]
    description_of: Callable[[Element], ModelDescription]
    findings: list[str]
    components: dict[_ElementPath, Element] = field(default_factory=dict)
    _systems: dict[_ElementPath, SystemElement] = field(default_factory=dict)
    _into: dict[_Node, tuple[_Node, Wire]] = field(default_factory=dict)
    _out_of: dict[_Node, list[tuple[_Node, Wire]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._enter((), self.root)
        for path, system in self._systems.items():
            for wire in system.wires:
                self._add_wire(path, system, wire)

    def _enter(self, path: _ElementPath, system: SystemElement) -> None:
        self._systems[path] = system
        for name, element in system.elements.items():
            if isinstance(element, SystemElement):
                self._enter((*path, name), element)
            else:
                self.components[*path, name] = element

    def _variable(self, node: _Node) -> Variable | None:
        """The variable of an FMU behind a node, if there is one."""
        element = self.components.get(node[0])
        if element is None:
            return None
        return self.description_of(element).find(node[1])

    # Connections

    def _add_wire(self, path: _ElementPath, system: SystemElement, wire: Wire) -> None:
        nodes = [self._node(path, system, end, wire) for end in (wire.start, wire.end)]
        gives = [self._gives(path, node) for node in nodes]
        if gives[0] is False or gives[1] is True:
            nodes.reverse()
            gives.reverse()
        if gives[0] is False or gives[1] is True:
            raise FMULoadError(
                f"the connection {wire} joins two connectors of which "
                f"{'both give' if gives[0] else 'none gives'} a value"
            )
        source, target = nodes
        other = self._into.setdefault(target, (source, wire))
        if other[0] != source:
            names = f"{_named(other[0])}, {_named(source)}"
            raise ConfigError(f"{_named(target)} has two sources: {names}")
        self._out_of.setdefault(source, []).append((target, wire))

    def _node(
        self, path: _ElementPath, system: SystemElement, end: tuple[str | None, str], wire: Wire
    ) -> _Node:
        element, connector = end
        if element is None:
            if connector not in system.connectors:
                raise FMULoadError(
                    f"the connection {wire}: the system {system.name!r} has no connector "
                    f"{shown(connector)}"
                )
            return path, connector
        if element not in system.elements:
            raise FMULoadError(
                f"the connection {wire}: the system {system.name!r} has no element {shown(element)}"
            )
        return (*path, element), connector

    def _gives(self, path: _ElementPath, node: _Node) -> bool | None:
        """Whether a connector gives a value to the inside of the system at ``path``."""
        place, name = node
        element = self.components.get(place) or self._systems[place]
        connector = element.connectors.get(name)
        if connector is not None and connector.kind not in {"inout", "unspecified"}:
            return connector.gives != (place == path)
        variable = self._variable(node)
        return None if variable is None else variable.causality in {"output", "local"}

    def connections(self) -> Iterator[Connection]:
        """The connections between components, and with the inputs and outputs of the root."""
        for target in self._into:
            at_root = target[0] == ()
            if at_root or target[0] in self.components:
                chain = self._chain(target)
                source = chain[0][0]
                if source[0] == () and at_root:
                    self.findings.append(
                        f"the connection {_named(source)} -> {_named(target)} joins no component "
                        "and is ignored"
                    )
                elif source[0] == () or source[0] in self.components or source in self._fans:
                    yield self._connection(target, chain)
        for target in self._nested_outputs():
            yield self._connection(target, self._chain(target))

    def connectors(self) -> Iterator[tuple[str, OwnConnector]]:
        """The connectors that can be inputs, outputs and parameters of the whole, by their names.

        These are those of the root; and those of nested systems that nothing outside drives and
        that lead to several components, or that an output of a component leads to.
        """
        yield from self.root.connectors.items()
        for place, name in (*self._fans, *self._nested_outputs()):
            yield _named((place, name)), self._systems[place].connectors[name]

    @cached_property
    def _fans(self) -> tuple[_Node, ...]:
        """The connectors of nested systems that are an input or parameter of the whole."""
        return tuple(
            node
            for node in self._out_of
            if node not in self._into
            and self._can_be_named(node)
            and len(list(self._reached(node, _Value()))) > 1
        )

    def _nested_outputs(self) -> Iterator[_Node]:
        """The connectors of nested systems that an output of a component leads to."""
        for node in self._into:
            if not self._can_be_named(node):
                continue
            gives = self._systems[node[0]].connectors[node[1]].gives
            if gives and self._chain(node)[0][0][0] in self.components:
                yield node

    def _can_be_named(self, node: _Node) -> bool:
        """Whether a node is a connector of a nested system whose name no component has."""
        place, name = node
        nested = place != () and place in self._systems and name in self._systems[place].connectors
        return nested and _named(node) not in self._names

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(map(".".join, self.components))

    def _chain(self, target: _Node) -> list[tuple[_Node, Wire]]:
        """The ways from the first source to a node."""
        chain: list[tuple[_Node, Wire]] = []
        node = target
        while node in self._into:
            chain.append(self._into[node])
            node = chain[-1][0]
            if len(chain) > len(self._into):
                raise FMULoadError(f"the connections to {_named(target)} form a circle of systems")
        return chain[::-1]

    def _connection(self, target: _Node, chain: list[tuple[_Node, Wire]]) -> Connection:
        first, wire = chain[0]
        ends = _named(first), _named(target)
        told = self._is_told(first) or self._is_told(target)
        if len(chain) == 1 and not told:  # kept as in the file
            return Connection(*ends, wire.scaling.factor, wire.scaling.offset, wire.convert)
        value = _Value(unit=self._unit(first), units=self._units_at(first))
        stops = [node for node, _ in chain[1:]] + [target]
        for (_, wire), stop in zip(chain, stops, strict=True):
            value = self._through(value, wire.convert, wire.scaling, stop)
        return Connection(*ends, value.change.factor, value.change.offset, convert_units=False)

    def _through(self, value: _Value, convert: bool, scaling: Conversion, node: _Node) -> _Value:
        """Convert a value to the unit of a node, then scale it."""
        unit = self._unit(node)
        conversion = IDENTITY
        if convert and value.unit is not None and unit is not None:
            conversion = conversion_of_link(value.unit, value.units, unit, self._units_at(node))
            variable = self._variable(node)
            conversion = conversion.of_differences(variable is not None and variable.relative)
        known = (value.unit, value.units) if unit is None else (unit, self._units_at(node))
        return _Value(scaling.after(conversion.after(value.change)), *known)

    def _unit(self, node: _Node) -> str | None:
        """Unit of a connector; the FMU's own unit takes precedence."""
        place, name = node
        variable = self._variable(node)
        if variable is not None and variable.unit is not None:
            return variable.unit
        element = self.components.get(place) or self._systems[place]
        connector = element.connectors.get(name)
        return None if connector is None else connector.unit

    def _is_told(self, node: _Node) -> bool:
        """Whether a connector gives its variable the unit that the FMU does not."""
        variable = self._variable(node)
        return variable is not None and variable.unit is None and self._unit(node) is not None

    def _units_at(self, node: _Node) -> Mapping[str, Unit]:
        element = self.components.get(node[0])
        return {**self.units, **({} if element is None else self.description_of(element).units)}

    # Parameters

    def start_values(self, read: Callable[[str], Any]) -> dict[_ElementPath, dict[str, Any]]:
        """The start values of each component, by the names of its variables.

        Bindings of a system win over those of its elements, later ones over earlier ones.

        Args:
            read: Returns the root of an XML file of the archive by its URI.
        """
        values: dict[_ElementPath, dict[str, Any]] = {path: {} for path in self.components}
        owners: list[tuple[_ElementPath, Element | SystemElement]] = [
            *self.components.items(),
            *self._systems.items(),
        ]
        for path, owner in sorted(owners, key=lambda item: -len(item[0])):
            for binding in owner.bindings:
                for setting in read_settings(binding, read, self.findings):
                    self._set(path, setting, values)
        return values

    def _set(
        self, path: _ElementPath, setting: Setting, values: dict[_ElementPath, dict[str, Any]]
    ) -> None:
        nodes = list(self._matching(path, setting.name))
        ends = [end for node in nodes for end in self._ends(node, setting)]
        for (place, name), value in ends:
            values[place][name] = value
        if not ends:
            self.findings.append(
                f"the parameter {shown(_named((path, setting.name)))} names nothing and is ignored"
            )

    def _matching(self, path: _ElementPath, name: str) -> Iterator[_Node]:
        """The nodes that a hierarchical name may mean, seen from an element."""
        if path in self.components:
            if self._variable((path, name)) is not None:
                yield path, name
            return
        system = self._systems[path]
        if name in system.connectors:
            yield path, name
        for dot in (place for place, letter in enumerate(name) if letter == "."):
            if name[:dot] in system.elements:
                yield from self._matching((*path, name[:dot]), name[dot + 1 :])

    def _ends(self, node: _Node, setting: Setting) -> Iterator[tuple[_Node, Any]]:
        """The variables of components that get a value by a node, and their values."""
        value = setting.value
        if isinstance(value, tuple):
            yield from self._ends_of_array(node, setting, value)
            return
        if isinstance(value, bool | str):
            for end, _ in self._reached(node, _Value()):
                yield end, value
            return
        units = {**self.units, **setting.units}
        given = _Value(Conversion(0.0, float(value)), setting.unit, units)
        known = self._through(given, setting.convert, setting.scaling, node)
        first = replace(known, unit=self._unit(node))
        for end, reached in self._reached(node, first):
            yield end, reached.change.offset

    def _ends_of_array(
        self, node: _Node, setting: Setting, values: tuple[float, ...]
    ) -> Iterator[tuple[_Node, Any]]:
        columns = [list(self._ends(node, replace(setting, value=value))) for value in values]
        for ends in zip(*columns, strict=True):
            yield ends[0][0], [value for _, value in ends]

    def _reached(self, node: _Node, value: _Value) -> Iterator[tuple[_Node, _Value]]:
        if node[0] in self.components:
            yield node, value
            return
        for target, wire in self._out_of.get(node, ()):
            if target != node and len(target[0]) > len(node[0]):
                following = self._through(value, wire.convert, wire.scaling, target)
                yield from self._reached(target, following)


def _named(node: _Node) -> str:
    return ".".join((*node[0], node[1]))


_VERSIONS: Final = {"1.0", "2.0"}

_extracted: Final[dict[tuple[Path, int, int], Path]] = {}
"""Folders of the FMUs of archives by path, time and size. They are removed with the process."""


def system_arguments(path: str | os.PathLike[str], limits: ArchiveLimits | None) -> dict[str, Any]:
    """Read an SSP archive as the arguments of an ``FMUSystem``. Nothing of its FMUs is executed.

    Nested systems become one level: a component ``plant`` of the system ``car`` is named
    ``car.plant``. Geometry, annotations and values for parameters that do not exist
    are ignored and listed in ``findings``.

    Args:
        path: The ``.ssp`` file.
        limits: Limits of the size of an archive; None for the default.

    Raises:
        ConfigError: If a connection has a mistake.
        FMULoadError: If the archive or an FMU cannot be read, or it has something that changes
            results and is not supported, such as signal dictionaries.
    """
    file = check_path("the path of a system", path).absolute()
    if not file.is_file():
        raise FMULoadError(f"there is no system at {file}")
    if not zipfile.is_zipfile(file):
        raise FMULoadError(f"{file.name} is no SSP archive: it is no zip archive")
    limits = limits or ArchiveLimits()
    reader = _Reader(SafeZip(file, limits), limits)
    try:
        return reader.arguments()
    except FMUGymError as error:
        raise type(error)(f"{file.name}: {error}") from None


@dataclass
class _Reader:
    """Reads one archive."""

    archive: SafeZip
    limits: ArchiveLimits
    findings: list[str] = field(default_factory=list)
    _fmus: dict[tuple[str, str | None], FMU] = field(default_factory=dict)

    def arguments(self) -> dict[str, Any]:
        root, element = self._root()
        tree, units = read_system(element, self.findings), read_units(root)
        flat = Flat(tree, units, lambda one: self._fmu(one).description, self.findings)
        connections = list(flat.connections())
        components = self._components(flat)
        used = {end for one in connections for end in (one.source, one.target)}
        self.findings += [*ignored(root), *_unconnected(tree, used)]
        return {
            "components": components,
            "connections": connections,
            "name": root.get("name") or tree.name,
            "units": _own_units(flat, used),
            "unit_definitions": units,
            "own_names": [name for name, _ in flat.connectors() if "." in name],
            "description": tree.description,
            "findings": [*self.archive.notes, *self.findings],
            "file": self.archive.path,
            **_experiment(root),
        }

    def _root(self) -> tuple[Any, Any]:
        """The roots of the file and of the systems in it."""
        if SSD not in self.archive.files:
            raise FMULoadError(f"it is no SSP archive: it has no {SSD}")
        root = self._xml(SSD)
        element = root.find("{*}System")
        if not root.tag.endswith("SystemStructureDescription") or element is None:
            raise FMULoadError(f"{SSD} describes no system")
        if root.get("version") not in _VERSIONS:
            self.findings.append(f"version {shown(root.get('version'))} of SSP is taken for 1.0")
        return root, element

    def _components(self, flat: Flat) -> dict[str, Component]:
        values = flat.start_values(self._resource)
        return {
            ".".join(path): Component(
                self._fmu(element),
                values[path],
                element.interface,
            )
            for path, element in flat.components.items()
        }

    def _fmu(self, element: Element) -> FMU:
        key = element.source, element.interface
        if key not in self._fmus:
            what = f"of the component {element.name!r}"
            file = _folder_of(self.archive) / self._place(element.source, what)
            self._fmus[key] = FMU(file, limits=self.limits, interface=element.interface)
        return self._fmus[key]

    def _resource(self, source: str) -> Any:
        return self._xml(self._place(source, "of a parameter binding"))

    def _place(self, source: str, what: str) -> str:
        """Find the file of a URI, which is relative to the system structure."""
        place = posixpath.normpath(unquote(source))
        if place not in self.archive.files:
            raise FMULoadError(f"the source {what} is {shown(source)}, which is not in the archive")
        return place

    def _xml(self, place: str) -> Any:
        content = read_xml(self.archive, place, self.limits.max_xml_bytes)
        return parse_xml(self.archive.path.name, place, content)


def _folder_of(archive: SafeZip) -> Path:
    """Extract the FMUs of an archive, once in a process."""
    status = archive.path.stat()
    key = archive.path, status.st_mtime_ns, status.st_size
    folder = _extracted.get(key)
    if folder is None or not folder.is_dir():
        folder = folder_name()
        make_folder(folder)
        fmus = [place for place in archive.files if place.lower().endswith(".fmu")]
        archive.extract(folder, {place: place for place in fmus})
        _extracted[key] = folder
    return folder


def _own_units(flat: Flat, used: Set[str]) -> dict[str, str]:
    """The units of the connectors of systems that connections use."""
    return {
        name: connector.unit
        for name, connector in flat.connectors()
        if connector.unit is not None and name in used
    }


def _unconnected(tree: SystemElement, used: Set[str]) -> list[str]:
    return [
        f"the connector {shown(name)} of the system is not connected and is ignored"
        for name in tree.connectors
        if name not in used
    ]


def _experiment(root: Any) -> dict[str, float]:
    """The times of the default experiment, as far as they are given."""
    element = root.find("{*}DefaultExperiment")
    names = {"start_time": "startTime", "stop_time": "stopTime"}
    given = {} if element is None else element.attrib
    return {name: number_in(element, key) for name, key in names.items() if key in given}
