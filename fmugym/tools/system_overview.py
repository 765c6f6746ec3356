"""Overview of a system: its main facts, as plain data and as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fmugym.archive.fmu import FMU
from fmugym.declared import Task
from fmugym.declared.task_fmu import fmu_of
from fmugym.errors import ConfigError, plain
from fmugym.systems import FMUSystem
from fmugym.tools.overview import headed, overview, tables

__all__ = ["as_text_of_system", "find_model", "open_model", "overview_of_system"]


def find_model(path: Path, master: str | None = None) -> FMU | FMUSystem:
    """Find the model of a path: an FMU, an SSP archive, or a task file with one of both.

    Args:
        path: The file.
        master: Master algorithm of a system, in the place of the one in the file.

    Raises:
        ConfigError: If the task file or the system has a mistake.
        FMULoadError: If the archive or an FMU cannot be read.
    """
    if path.suffix.lower() == ".ssp":
        return FMUSystem.read(path, master=master)
    if path.suffix.lower() == ".toml":
        return _model_of(Task.read(path), master)
    if master is not None:
        raise ConfigError(f"a master is for systems; {path.name} is a single FMU")
    return FMU(path)


def _model_of(task: Task, master: str | None) -> FMU | FMUSystem:
    """The system that a task file names, or the FMU with the libraries of the task."""
    source = fmu_of(task, master)
    if isinstance(source, FMUSystem):
        return source
    preload = task.root.child("foreign").child("preload").value
    return FMU(source, preload=preload or ())


def open_model(path: Path) -> FMU:
    """Open an FMU, or the system of an SSP archive in its place.

    Raises:
        ConfigError: If the system has a mistake.
        FMULoadError: If it cannot be read.
    """
    return FMUSystem.read(path).as_fmu() if path.suffix.lower() == ".ssp" else FMU(path)


def overview_of_system(
    system: FMUSystem, *, everything: bool = False, pattern: str | None = None
) -> dict[str, Any]:
    """Gather the facts about a system.

    Args:
        system: The system.
        everything: As for ``overview``.
        pattern: As for ``overview``.

    Returns:
        As ``overview``, with ``system``, a dict; ``docs/command-line.md`` describes the keys.
    """
    fmu = system.as_fmu()
    facts = overview(fmu, everything=everything, pattern=pattern)
    groups = [
        {"components": list(group.components), "is_loop": group.loop is not None}
        for group in system.order.groups
    ]
    resets = (facts["trial"] or {}).get("component_resets", {})
    facts["system"] = {
        "components": [
            _component(system, name) | {"begins_by": resets.get(name)} for name in system.components
        ],
        "connections": [asdict(link) for link in system.links],
        "connectors": [asdict(connector) for connector in system.connectors],
        "master": system.master,
        "order": groups,
        "loops": [[asdict(link) for link in loop] for loop in system.order.loops],
    }
    return facts


def _component(system: FMUSystem, name: str) -> dict[str, Any]:
    component = system.components[name]
    description = component.fmu.description
    return {
        "name": name,
        "fmu": str(component.fmu.path),
        "fmi_version": description.fmi_version,
        "interface": description.interface,
        "generation_tool": description.generation_tool,
        "steps": component.given.steps,
        "isolate": component.given.isolate,
        "start_values": dict(component.starts),
    }


def as_text_of_system(facts: Mapping[str, Any], *, is_short: bool = True) -> str:
    """Format an overview of a system for a terminal.

    Args:
        facts: The result of ``overview_of_system``.
        is_short: As for ``as_text``.

    Returns:
        Lines of printable ASCII.
    """
    kind = f"a system of {len(facts['system']['components'])} FMUs"
    heading = [*headed(facts, kind, _rows(facts)), *_parts(facts["system"])]
    return "\n".join([*heading, *tables(facts, is_short)])


def _rows(facts: Mapping[str, Any]) -> dict[str, str]:
    times = facts["default_experiment"]
    step = times["step_size"]
    obstacles = "; ".join(facts["obstacles"])
    isolated = any(one["isolate"] for one in facts["system"]["components"])
    how = "runs here, in worker processes" if isolated else "runs here"
    return {
        "file": facts["path"],
        "this machine": f"does NOT run here: {obstacles}" if obstacles else how,
        "step": "not given" if step is None else f"{step:g} s",
        "master": facts["system"]["master"],
        "order": " -> ".join(map(_group, facts["system"]["order"])),
    }


def _group(group: Mapping[str, Any]) -> str:
    names = ", ".join(group["components"])
    return f"({names})" if group["is_loop"] else names


def _parts(system: Mapping[str, Any]) -> Iterator[str]:
    yield f"\nComponents ({len(system['components'])})"
    for one in system["components"]:
        kind = "model exchange" if one["interface"] == "model_exchange" else "co-simulation"
        text = f"{one['name']}: {Path(one['fmu']).name}, FMI {one['fmi_version']} {kind}"
        tool = f", by {one['generation_tool']}" if one["generation_tool"] else ""
        steps = f", {one['steps']} steps in one of the system" if one["steps"] > 1 else ""
        begins = f", episodes begin by {one['begins_by']!r}" if one["begins_by"] else ""
        isolate = ", isolated" if one["isolate"] else ""
        yield f"  {plain(text + tool + steps + isolate + begins)}"
    yield f"\nConnections ({len(system['connections'])})"
    for link in system["connections"]:
        yield f"  {plain(_link(link))}"
    if system["connectors"]:
        yield f"\nNames of the system ({len(system['connectors'])})"
    for connector in system["connectors"]:
        yield f"  {plain(_connector(connector))}"
    for loop in system["loops"]:
        yield "\nAlgebraic loop: " + plain("; ".join(map(_link, loop)))


def _link(link: Mapping[str, Any]) -> str:
    change = _change(link["gain"], link["offset"])
    return f"{link['source']}.{link['output']} -> {link['target']}.{link['input']}{change}"


def _change(gain: float, offset: float) -> str:
    """Describe the conversion of a value on its way."""
    parts = [f"* {gain:.6g}"] if gain != 1 else []
    if offset:
        parts.append(f"{'+' if offset > 0 else '-'} {abs(offset):.6g}")
    return f" ({' '.join(parts)})" if parts else ""


def _connector(connector: Mapping[str, Any]) -> str:
    ends = [
        f"{end['component']}.{end['variable']}{_change(end['gain'], end['offset'])}"
        for end in connector["ends"]
    ]
    arrow = "<-" if connector["causality"] == "output" else "->"
    return f"{connector['causality']} {connector['name']} {arrow} {', '.join(ends)}"
