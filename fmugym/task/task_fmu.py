"""The FMU of a task, or the system that a task declares in its place."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from fmugym.environment.fmu_variables import structural_values
from fmugym.errors import FMULoadError, TaskError, missing_file
from fmugym.fmi.bundled import bundled_fmu
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.fmu import FMU
from fmugym.fmi.systems import Component, FMUSystem
from fmugym.fmi.systems.components import Connection, OpenComponent
from fmugym.keys import table_of_fields
from fmugym.task.task_entries import Entry
from fmugym.task.task_file import Task

__all__ = ["described", "fmu_of"]


def described(root: Entry, master: str | None = None) -> tuple[Path | FMUSystem, ModelDescription]:
    """Find the FMU or system of a task, and read its description.

    What is wrong with the rest of the task is left in the mistakes of the root.

    Args:
        root: The table of all keys of the task.
        master: Master algorithm of a system, in the place of the one of its archive or of the task.

    Raises:
        ConfigError: If there is none; the text tells all mistakes that are known then.
        FMULoadError: If it cannot be read, and the task has no mistake.
    """
    found: list[tuple[Path | FMUSystem, ModelDescription]] = []
    try:
        with root.noting():
            source = _source(root, master)
            found.append((source, _describe(root, source)))
    except FMULoadError:
        root.mistakes.require_none()
        raise
    if not found:
        root.mistakes.require_none()
    return found[0]


def fmu_of(task: Task, master: str | None = None) -> Path | FMUSystem:
    """Find the FMU of a task: the path of an FMU, or the system of an SSP archive or of the file.

    Args:
        task: The task.
        master: Master algorithm of a system, in the place of the one in the archive or the file.

    Raises:
        ConfigError: If the task names none, or there is no bundled FMU of this name.
    """
    root = task.root
    source = _source(root, master)
    root.mistakes.require_none()
    return source


def _source(root: Entry, master: str | None) -> Path | FMUSystem:
    section = root.child("system")
    if section.value is None:
        return _fmu_or_archive(root.required("fmu"), master)
    if root.child("fmu").value is not None:
        raise section.error("a task has either 'fmu' or 'system'")
    return _system(section, master)


def _fmu_or_archive(entry: Entry, master: str | None) -> Path | FMUSystem:
    path = _path(entry)
    if path.suffix.lower() == ".ssp":
        state = _state(entry, path)
        with entry.placing(), _placing_load(entry):
            return _read_archive(*state, master)
    if master is not None:
        raise entry.error(f"a master is for systems; {path.name} is a single FMU")
    return path


@contextmanager
def _placing_load(entry: Entry) -> Iterator[None]:
    """Add the place of a file in the task to errors about the file."""
    try:
        yield
    except FMULoadError as error:
        raise type(error)(str(entry.error(error))) from error


@lru_cache(maxsize=16)
def _read_archive(path: Path, changed: int, size: int, master: str | None) -> FMUSystem:
    return FMUSystem.read(path, master=master)


def _path(entry: Entry) -> Path:
    given = entry.value
    if isinstance(given, str):
        return Path(given)
    with entry.placing():
        return bundled_fmu(entry.required("bundled").value, given["fmi_version"])


def _system(section: Entry, master: str | None) -> FMUSystem:
    """Make the system that the section ``[system]`` declares, as far as it has no mistakes."""
    components: dict[str, Component] = {}
    states: list[_State] = []
    for name, entry in section.child("components").items().items():
        with entry.noting():
            components[name], state = _component(entry)
            states.append(state)
    if not components:
        section.mistakes.require_none()
    key = repr(section.value), tuple(states), master
    known = _known.get(key)
    if known is not None:
        return known
    connections = [entry.value for entry in section.child("connections").elements()]
    options = {**section.value, "components": components, "connections": connections}
    if master is not None:
        options["master"] = master
    try:
        with section.placing():
            section.mistakes.require_none()
            system = FMUSystem(**options)
    except TaskError:
        return _sound_part(section, options)
    while len(_known) >= _MOST_KNOWN:
        _known.pop(next(iter(_known)))
    _known[key] = system
    return system


def _sound_part(section: Entry, options: dict[str, Any]) -> FMUSystem:
    """Note the mistakes of a system, and make a system of its sound part."""
    sound = {**options, "components": {}, "connections": [], "units": {}}
    for name, component in options["components"].items():
        for given in (replace(component, start_values={}), component):
            with section.child("components").child(name).noting():
                fmu = OpenComponent(name, given).fmu
                sound["components"][name] = replace(given, fmu=fmu)
    hidden = section.mistakes.hidden
    hidden |= section.child("components").items().keys() - sound["components"].keys()
    for entry in section.child("connections").elements():
        one = entry.value
        if not isinstance(one, Connection):  # its mistake is noted
            continue
        ends = {one.source, one.target}
        with replace(entry, element=f"{one.source} -> {one.target}").noting():
            if hidden.isdisjoint(name.partition(".")[0] for name in ends):
                FMUSystem(**{**sound, "connections": [*sound["connections"], one]})
                sound["connections"].append(one)
        if one not in sound["connections"]:
            hidden |= ends
    with section.child("units").noting():
        return FMUSystem(**{**sound, "units": options.get("units", {})})
    return FMUSystem(**sound)


_MOST_KNOWN: Final = 16
_known: Final[dict[Any, FMUSystem]] = {}
"""Systems by their declarations and the state of their FMUs, shared by the environments of a
task."""


def _component(entry: Entry) -> tuple[Component, _State]:
    fmu = entry if entry.child("fmu").value is None else entry.child("fmu")
    own = {
        name: entry.value[name] for name in table_of_fields(Component).keys if name in entry.value
    }
    state = _state(fmu, _path(fmu))
    with entry.placing():
        return Component(**{**own, "fmu": state[0]}), state


def _describe(root: Entry, source: Path | FMUSystem) -> ModelDescription:
    """Read the description of the FMU or system of a task, once for all environments of it.

    Raises:
        ConfigError: If there is no such file; the text names the nearest one.
        FMULoadError: If it cannot be read.
    """
    if isinstance(source, FMUSystem):
        return source.as_fmu().description
    entry = root.child("fmu")
    state = _state(entry, source)
    with _placing_load(entry):
        description = _read_description(*state)
    return _resized(description, root.child("parameters"))


def _resized(description: ModelDescription, parameters: Entry) -> ModelDescription:
    """Give arrays the sizes that the task gives to structural parameters."""
    given = parameters.value if isinstance(parameters.value, dict) else {}
    with parameters.noting():
        sizes = structural_values(description, given)
        return description.resized(sizes) if sizes else description
    return description


_State = tuple[Path, int, int]
"""A file, and its time of change and size, which change with the content."""


def _state(entry: Entry, path: Path) -> _State:
    """The state of a file that must exist."""
    try:
        status = path.stat()
        return path, status.st_mtime_ns, status.st_size
    except (OSError, ValueError):  # there is none, or no file could have such a name
        raise entry.error(missing_file("FMU", path, f"*{path.suffix or '.fmu'}")) from None


@lru_cache(maxsize=16)
def _read_description(path: Path, changed: int, size: int) -> ModelDescription:
    return FMU(path).description
