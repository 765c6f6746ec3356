"""Reading an SSP archive."""

from __future__ import annotations

import os
import posixpath
import zipfile
from collections.abc import Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from fmugym.archive.fmu import FMU
from fmugym.archive.reading import parse_xml, read_xml
from fmugym.archive.safe_zip import ArchiveLimits, SafeZip
from fmugym.archive.temporary import folder_name, make_folder
from fmugym.checks import check_path
from fmugym.errors import FMUGymError, FMULoadError, shown
from fmugym.systems.components import Component
from fmugym.systems.ssp.elements import (
    SSD,
    Element,
    SystemElement,
    ignored,
    number_in,
    read_system,
    read_units,
)
from fmugym.systems.ssp.flat import Flat

__all__ = ["system_arguments"]

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
