"""The FMU of a task, or the system that a task declares in its place."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from fmugym.archive.bundled import bundled_fmu
from fmugym.archive.description import ModelDescription
from fmugym.archive.fmu import FMU
from fmugym.checks import check_count, check_flag, check_number
from fmugym.declared.entries import Entry
from fmugym.declared.quantities import duration
from fmugym.declared.task import Task
from fmugym.errors import FMULoadError, shown, unknown_name
from fmugym.signals import ordinary
from fmugym.systems import Component, Connection, FMUSystem
from fmugym.task.starting import structural_values

__all__ = ["describe", "fmu_of", "system_of"]

_KEYS: Final = (
    *("components", "connections", "name", "description", "units", "master", "loops"),
    *("loop_tolerance", "loop_iterations", "step_size", "tolerance"),
)
_COMPONENT_KEYS: Final = ("fmu", "start_values", "interface", "steps", "feedthrough", "isolate")
_CONNECTION_KEYS: Final = ("source", "target", "gain", "offset", "convert_units")
_CHECKS: Final[dict[str, Callable[..., Any]]] = {
    "loop_tolerance": check_number,
    "loop_iterations": check_count,
    "step_size": duration,
    "tolerance": check_number,
    "steps": check_count,
    "feedthrough": check_flag,
    "isolate": check_flag,
    "gain": check_number,
    "offset": check_number,
    "convert_units": check_flag,
}
"""All other keys are texts."""


def fmu_of(task: Task, master: str | None = None) -> Path | FMUSystem:
    """Find the FMU of a task: the path of an FMU, or the system of an SSP archive or of the file.

    Args:
        task: The task.
        master: Of a system, in the place of what the archive or the file says.

    Raises:
        ConfigError: If the task names none, or there is no bundled FMU of this name.
    """
    section = task.root.child("system")
    if section.value is None:
        return _fmu_or_archive(task.root.required("fmu"), master)
    if task.root.child("fmu").value is not None:
        raise section.error("a task has either 'fmu' or 'system'")
    return system_of(section, master)


def _fmu_or_archive(entry: Entry, master: str | None) -> Path | FMUSystem:
    path = _path(entry)
    if path.suffix.lower() == ".ssp":
        status = _status(entry, path)
        with entry.placing(), _placing_load(entry):
            return _read_archive(path, status.st_mtime_ns, status.st_size, master)
    if master is not None:
        raise entry.error(f"a master is for systems; {path.name} is a single FMU")
    return path


@contextmanager
def _placing_load(entry: Entry) -> Iterator[None]:
    """Let errors of a file say where the task names it."""
    try:
        yield
    except FMULoadError as error:
        raise type(error)(str(entry.error(error))) from error


@lru_cache(maxsize=16)
def _read_archive(path: Path, changed: int, size: int, master: str | None) -> FMUSystem:
    return FMUSystem.read(path, master=master)


def _path(entry: Entry) -> Path:
    if isinstance(entry.value, str):
        return Path(entry.value)
    if not isinstance(entry.value, Mapping):
        raise entry.error(
            f"expected the path of an FMU, or a table such as {{ bundled = 'Pendulum' }}, got "
            f"{shown(entry.value)}"
        )
    table = entry.table(("bundled", "fmi_version"))
    version: Any = table["fmi_version"].value if "fmi_version" in table else "2.0"
    with entry.placing():
        return bundled_fmu(entry.required("bundled").text(), version)


def system_of(section: Entry, master: str | None = None) -> FMUSystem:
    """Make the system that the section ``[system]`` declares.

    Args:
        section: The section.
        master: In the place of what it says.

    Raises:
        ConfigError: If it has a mistake. The text says where.
        FMULoadError: If an FMU cannot be read.
    """
    table = section.table(_KEYS)
    named = section.required("components").items()
    components = {name: _component(entry) for name, entry in named.items()}
    states = tuple(map(_version, components.values()))
    key = json.dumps(section.value, default=repr), states, master
    known = _known.get(key)
    if known is not None:
        return known
    options = {name: _value(table[name]) for name in table if name not in _TABLES}
    if master is not None:
        options["master"] = master
    if "units" in table:
        units = table["units"].items()
        options["units"] = {name: entry.text() for name, entry in units.items()}
    with section.placing():
        system = FMUSystem(components, _connections(section), **options)
    while len(_known) >= _MOST_KNOWN:
        _known.pop(next(iter(_known)))
    _known[key] = system
    return system


_TABLES: Final = ("components", "connections", "units")
_MOST_KNOWN: Final = 16
_known: Final[dict[Any, FMUSystem]] = {}
"""Systems by what declares them and the state of their FMUs: environments of a task share one."""


def _component(entry: Entry) -> Component:
    if isinstance(entry.value, str) or entry.child("bundled").value is not None:
        return Component(_found(entry))
    table = entry.table(_COMPONENT_KEYS)
    options = {n: _value(table[n]) for n in table if n not in {"fmu", "start_values"}}
    if "start_values" in table:
        given = table["start_values"].items()
        options["start_values"] = {name: one.value for name, one in given.items()}
    with entry.placing():
        return Component(_found(entry.required("fmu")), **options)


def _found(entry: Entry) -> Path:
    """The path of the FMU of a component, which must exist."""
    path = _path(entry)
    _status(entry, path)
    return path


def _version(component: Component) -> tuple[str, int, int]:
    path = Path(component.fmu)  # type: ignore[arg-type]  # they are paths here
    status = path.stat()
    return str(path), status.st_mtime_ns, status.st_size


def _connections(section: Entry) -> list[Connection]:
    entry = section.child("connections")
    return [] if entry.value is None else [_connection(one) for one in entry.elements()]


def _connection(entry: Entry) -> Connection:
    if isinstance(entry.value, str):
        with entry.placing():
            return Connection.of(entry.value)
    table = entry.table(_CONNECTION_KEYS)
    source, target = (entry.required(end).text() for end in ("source", "target"))
    options = {name: _value(table[name]) for name in table if name not in {"source", "target"}}
    with entry.placing():
        return Connection(source, target, **options)


def _value(entry: Entry) -> Any:
    check = _CHECKS.get(entry.name)
    return entry.text() if check is None else entry.check(check)


def describe(task: Task, source: Path | FMUSystem) -> ModelDescription:
    """Read the description of the FMU or system of a task, once for all environments of it.

    Raises:
        ConfigError: If there is no such file; the text names the nearest one.
        FMULoadError: If it cannot be read.
    """
    if isinstance(source, FMUSystem):
        return source.as_fmu().description
    entry = task.root.child("fmu")
    status = _status(entry, source)
    with _placing_load(entry):
        description = _read_description(source, status.st_mtime_ns, status.st_size)
    return _resized(description, task.root.child("parameters"))


def _resized(description: ModelDescription, parameters: Entry) -> ModelDescription:
    """Give arrays the sizes that the task gives to structural parameters."""
    given = parameters.value if isinstance(parameters.value, dict) else {}
    with parameters.placing():
        sizes = structural_values(description, given)
        return description.resized(sizes) if sizes else description


def _status(entry: Entry, path: Path) -> Any:
    """The state of a file that must exist."""
    try:
        return path.stat()
    except ordinary(OSError, ValueError):  # there is none, or no file could have such a name
        near = sorted(file.name for file in path.parent.glob(f"*{path.suffix or '.fmu'}"))
        folder = shown(str(path.parent))
        raise entry.error(f"{unknown_name('FMU', path.name, near)} (looked in {folder})") from None


@lru_cache(maxsize=16)
def _read_description(path: Path, changed: int, size: int) -> ModelDescription:
    return FMU(path).description
