"""Overviews of FMUs and of systems: their main facts, as plain data and as text.

They come from the archive and the XML. Nothing of the FMU is executed.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from fmugym.errors import ConfigError, FMULoadError, plain
from fmugym.fmi.fmu import FMU
from fmugym.fmi.library_dependencies import missing_tool, note_on
from fmugym.fmi.systems import FMUSystem
from fmugym.fmi.variable import Variable
from fmugym.pool.opening import Execution, PoolOptions
from fmugym.pool.pool_spec import PoolSpec
from fmugym.pool.trial.verdict import MOST_INSTANCES, Verdict, known_verdict
from fmugym.records.evaluation import aligned
from fmugym.records.recorded_quantities import matches
from fmugym.task import Task
from fmugym.task.task_fmu import fmu_of

__all__ = [
    "as_text",
    "as_text_of_system",
    "find_model",
    "finite_or_none",
    "headed",
    "open_model",
    "overview",
    "overview_of_system",
    "tables",
    "typed_start",
]

_SHOWN: Final = ("input", "output", "parameter")
"""The causalities that are listed by default."""

_HEADINGS: Final = {
    "input": "Inputs",
    "output": "Outputs",
    "parameter": "Parameters",
    "structuralParameter": "Structural parameters",
    "calculatedParameter": "Calculated parameters",
    "local": "Locals",
    "independent": "Independent variables",
}
_COLUMNS: Final = ("name", "type", "unit", "range", "start", "variability", "description")
_WIDEST: Final = 44
_MOST_PARAMETERS: Final = 20
_MOST_FINDINGS: Final = 10
"""They leave the overview on one page."""


def overview(fmu: FMU, *, everything: bool = False, pattern: str | None = None) -> dict[str, Any]:
    """Gather the facts about an FMU.

    Args:
        fmu: The FMU.
        everything: List variables of all causalities, not only those in ``_SHOWN``.
        pattern: List the variables of all causalities whose name matches. ``*`` matches any text
            and ``?`` one character; brackets match themselves, since names of arrays have them.

    Returns:
        Dicts, lists, strings, finite numbers, Booleans and None; ``fmugym.cli.command_line``
        describes the keys. Variables are in the order of the model description.
    """
    description = fmu.description
    variables = description.everything
    return {
        "path": str(fmu.path),
        **{name: getattr(description, name) for name in _TEXTS},
        "interfaces": list(description.interfaces),
        "platforms": list(fmu.platforms),
        "platform": fmu.platform,
        "library": fmu.library,
        "runs_here": fmu.runs_here,
        "in_wine": fmu.in_wine,
        "obstacles": list(fmu.obstacles),
        "missing_libraries": [{"name": n, "note": note_on(n)} for n in _missing_libraries(fmu)],
        "missing_tool": missing_tool(
            description.generation_tool, description.capabilities.needs_execution_tool
        ),
        "capabilities": asdict(description.capabilities),
        "default_experiment": {name: getattr(description, name) for name in _TIMES},
        "fixed_internal_step_size": description.fixed_internal_step_size,
        "trial": _trial(fmu),
        "findings": list(fmu.findings),
        "variable_counts": dict(Counter(variable.causality for variable in variables)),
        "variables": [_row(v) for v in variables if _is_wanted(v, everything, pattern)],
    }


def _trial(fmu: FMU) -> dict[str, Any] | None:
    """Results of the trial on this machine; None if there was none yet."""
    verdict = known_verdict(fmu)
    if verdict is None:
        return None
    return {
        "deterministic": verdict.deterministic,
        "noisy_outputs": list(verdict.noisy),
        "resets": {str(method): str(grade) for method, grade in verdict.resets.items()},
        "reset_method": str(verdict.reset_method) if verdict.resets else None,
        "component_resets": verdict.components_of(getattr(fmu, "plan", None)),
        "several_instances": None if verdict.neighbours is None else str(verdict.neighbours),
        "isolate": verdict.isolate,
        "cannot_be_read_before_a_step": verdict.blind_start,
        "instances_at_once": verdict.instances,
        "initializations": verdict.initializations,
        "findings": list(verdict.findings),
        "execution": _execution(fmu, verdict),
    }


def _execution(fmu: FMU, verdict: Verdict) -> list[str]:
    """Sentences on how one instance and several of them run by default, and why."""
    spec, options = PoolSpec((), (), 1.0), PoolOptions()
    counts = (1,) if verdict.neighbours is None else (1, MOST_INSTANCES)
    told = dict[str, None]()
    with suppress(FMULoadError):  # the obstacles tell why
        options = options.fitting(fmu)
        for count in counts:
            execution = Execution.decided(fmu, spec, count, options, verdict)
            told |= dict.fromkeys(execution.sentences)
    return list(told)


def _missing_libraries(fmu: FMU) -> tuple[str, ...]:
    try:
        return fmu.missing_libraries
    except FMULoadError:  # the obstacles tell why
        return ()


_TEXTS: Final = (
    "fmi_version",
    "model_name",
    "model_identifier",
    "instantiation_token",
    "description",
    "generation_tool",
)
_OF_VARIABLE: Final = (
    *("name", "causality", "variability", "initial", "type", "unit", "nominal", "description"),
    *("settable_at_start", "settable_in_step"),
)
_TIMES: Final = ("start_time", "stop_time", "step_size", "tolerance")


def _is_wanted(variable: Variable, everything: bool, pattern: str | None) -> bool:
    if pattern is None:
        return everything or variable.causality in _SHOWN
    return matches(pattern, variable.name)


def _row(variable: Variable) -> dict[str, Any]:
    return {
        **{name: getattr(variable, name) for name in _OF_VARIABLE},
        "shape": list(variable.shape),
        "min": finite_or_none(variable.minimum),
        "max": finite_or_none(variable.maximum),
        "start": typed_start(variable),
        "items": [{"name": name, "value": value} for name, value in variable.items],
    }


def finite_or_none(number: float) -> float | None:
    """Return a finite number; None for infinity and NaN, which JSON lacks."""
    return number if math.isfinite(number) else None


def typed_start(variable: Variable) -> bool | int | float | str | None:
    """Convert a start value from its text in the XML to the type of the variable.

    Returns:
        The value; the text itself for strings, arrays and what is not finite or malformed.
    """
    text = variable.start
    if text is None or variable.shape or variable.kind in {"string", "binary", "clock"}:
        return text
    if variable.kind == "boolean":
        return {"true": True, "1": True, "false": False, "0": False}.get(text.lower(), text)
    try:
        number = float(text) if variable.kind == "real" else int(text)
        return number if math.isfinite(number) else text
    except (ValueError, OverflowError):
        return text


def as_text(facts: Mapping[str, Any], *, is_short: bool = True) -> str:
    """Format an overview for a terminal.

    Args:
        facts: The result of ``overview``.
        is_short: Whether it is one page: with the first parameters and findings only.

    Returns:
        Lines of printable ASCII.
    """
    kind = f"FMI {facts['fmi_version']}"
    return "\n".join([*headed(facts, kind, _rows(facts)), *tables(facts, is_short)])


def tables(facts: Mapping[str, Any], is_short: bool) -> Iterator[str]:
    """The part of an overview below the heading: the trial, findings, variables.

    Args:
        facts: The result of ``overview``.
        is_short: Whether only the first parameters and findings are listed.
    """
    yield from _trial_lines(facts)
    yield from _findings(facts["findings"], _MOST_FINDINGS if is_short else None)
    yield from _tables(facts, _MOST_PARAMETERS if is_short else None)
    yield from _not_listed(facts)


def headed(facts: Mapping[str, Any], kind: str, rows: Mapping[str, str]) -> Iterator[str]:
    """Heading of an overview: its subject, and some facts by name."""
    yield plain(f"{facts['model_name']} ({kind})")
    if facts["description"]:
        yield plain(facts["description"])
    for name, value in rows.items():
        yield f"  {name:<20}{plain(value)}"


def _rows(facts: Mapping[str, Any]) -> dict[str, str]:
    return {
        "file": facts["path"],
        "generated by": facts["generation_tool"] or "not given",
        "interfaces": ", ".join(facts["interfaces"]),
        "platforms": ", ".join(facts["platforms"]) or "none",
        "this machine": _this_machine(facts),
        "first meeting": _first_meeting(facts["trial"]),
        "default experiment": _experiment(facts),
        "capabilities": ", ".join(n for n, flag in facts["capabilities"].items() if flag) or "none",
    }


def _this_machine(facts: Mapping[str, Any]) -> str:
    platform, tool = facts["platform"], facts["missing_tool"]
    if not facts["runs_here"]:
        how = "does NOT run here" if facts["trial"] is None else "has run here, but not like this"
        return f"{platform}: {how}: {'; '.join(facts['obstacles'])}"
    how = "runs here, in Wine" if facts["in_wine"] else "runs here"
    return f"{platform}: {how}" + (f" if it is installed: {tool}" if tool else "")


def _first_meeting(trial: Mapping[str, Any] | None) -> str:
    if trial is None:
        return "none on this machine; the first use tries an FMU, unless fmugym brings it along"
    grades = ", ".join(f"{method} is {_GRADES[g]}" for method, g in trial["resets"].items())
    parts = [grades] if grades else []
    count = trial["instances_at_once"]
    parts = parts or ["it survived"]
    parts.append(f"tried with {count} {'instance' if count == 1 else 'instances'} at once")
    parts.append(f"{trial['initializations']} initializations")
    return "; ".join(parts)


_GRADES: Final = {
    "bitwise": "right to the last bit",
    "tolerance": "right within the solver's tolerance",
    "wrong": "wrong",
    "fails": "failing",
    "absent": "not offered",
}


def _experiment(facts: Mapping[str, Any]) -> str:
    times = dict(facts["default_experiment"])
    if facts["fixed_internal_step_size"] is not None:
        times["internal step"] = facts["fixed_internal_step_size"]
    units = {"tolerance": ""}
    return ", ".join(
        f"{name.removesuffix('_time').removesuffix('_size')} "
        + ("not given" if value is None else f"{value:g}{units.get(name, ' s')}")
        for name, value in times.items()
    )


def _trial_lines(facts: Mapping[str, Any]) -> Iterator[str]:
    for key, heading in (("findings", "First meeting"), ("execution", "Execution")):
        sentences = (facts["trial"] or {}).get(key, ())
        if sentences:
            yield f"\n{heading}"
        for sentence in sentences:
            yield f"  - {plain(sentence)}"


def _findings(findings: Sequence[str], most: int | None) -> Iterator[str]:
    if findings:
        yield f"\nFindings ({len(findings)})"
        yield from _first([f"- {plain(finding)}" for finding in findings], most)


def _first(lines: Sequence[str], most: int | None) -> Iterator[str]:
    """The first lines, and the number of the others."""
    yield from (f"  {line}" for line in lines[:most])
    if most is not None and len(lines) > most:
        yield f"  {len(lines) - most} more with -v"


def _tables(facts: Mapping[str, Any], most_parameters: int | None) -> Iterator[str]:
    causalities = [*_HEADINGS, *facts["variable_counts"]]  # unknown ones last
    for causality in dict.fromkeys(causalities):
        rows = [v for v in facts["variables"] if v["causality"] == causality]
        if rows:
            yield f"\n{_HEADINGS.get(causality, plain(causality))} ({len(rows)})"
            head, *lines = aligned([_COLUMNS, *map(_cells, rows)], _WIDEST)
            yield f"  {head}"
            yield from _first(lines, most_parameters if causality == "parameter" else None)


def _not_listed(facts: Mapping[str, Any]) -> Iterator[str]:
    listed = Counter(variable["causality"] for variable in facts["variables"])
    left_out = Counter(facts["variable_counts"]) - listed
    if left_out:
        counts = ", ".join(f"{count} {plain(name)}" for name, count in left_out.items())
        yield f"\nNot listed: {counts}"


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    shape = f"[{','.join(map(str, row['shape']))}]" if row["shape"] else ""
    start = row["start"]
    cells = (
        row["name"],
        row["type"] + shape,
        row["unit"] or "-",
        _range(row),
        "-" if start is None else f"{start:.10g}" if isinstance(start, float) else start,
        row["variability"],
        row["description"],
    )
    return tuple(map(plain, cells))


def _range(row: Mapping[str, Any]) -> str:
    if row["items"]:
        return " ".join(f"{item['value']}={item['name']}" for item in row["items"])
    low, high = row["min"], row["max"]
    if low is None and high is None:
        return "-"
    return f"{-math.inf if low is None else low:g} .. {math.inf if high is None else high:g}"


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
    heading = [*headed(facts, kind, _rows_of_system(facts)), *_parts(facts["system"])]
    return "\n".join([*heading, *tables(facts, is_short)])


def _rows_of_system(facts: Mapping[str, Any]) -> dict[str, str]:
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
