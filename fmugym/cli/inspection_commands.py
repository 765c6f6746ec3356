"""Commands ``info``, ``new`` and ``validate``, about an FMU or a task itself.

``info`` shows a task's data, too, as read from the files.
"""

from __future__ import annotations

import argparse
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.cli.class_skeleton import Skeleton
from fmugym.cli.minari_datasets import show_dataset
from fmugym.cli.options import (
    MINARI,
    Commands,
    add_command,
    add_json,
    add_master,
    add_task,
    say,
    say_json,
    say_result,
    write_text,
)
from fmugym.cli.overview import (
    as_text,
    as_text_of_system,
    find_model,
    open_model,
    overview,
    overview_of_system,
)
from fmugym.cli.task_arguments import maker_of
from fmugym.cli.task_proposal import Proposal, preload_line
from fmugym.cli.validation import validate
from fmugym.errors import ConfigError, FMUGymError, plain, reason
from fmugym.fmi.fmu import FMU
from fmugym.fmi.fortran_libraries import build_stand_in, replaceable
from fmugym.fmi.source_compiler import compile_fmu
from fmugym.fmi.systems import FMUSystem
from fmugym.task import Task, load
from fmugym.task.data_rows import DataRows, read_rows, standard_time, usual_distance
from fmugym.task.dates import offset_text
from fmugym.task.scenarios import files_of
from fmugym.task.task_entries import Entry
from fmugym.task.task_keys import SCHEMA
from fmugym.training.search.suggested_controllers import controllers_for

__all__ = ["add_info", "add_new", "add_validate", "data_as_text", "overview_of_data"]


def overview_of_data(task: Task) -> dict[str, Any]:
    """Gather the facts about the data of a task.

    Args:
        task: The task.

    Returns:
        Dicts, lists, texts and numbers; ``docs/command-line.md`` describes the keys.
    """
    root = task.root
    try:
        standard = standard_time(root)
    except ConfigError as error:
        return {"standard_time": None, "error": str(error), "series": []}
    series = [
        facts
        for name, entry in root.child("data").items().items()
        if "file" in entry.value
        for facts in _files(name, entry, standard.offset)
    ]
    told = None if standard.offset is None else str(standard)
    return {"standard_time": told, "error": None, "series": series}


def _files(name: str, entry: Entry, standard: int | None) -> list[dict[str, Any]]:
    """The facts about each file of a series, with its number if an episode draws one."""
    try:
        files = files_of(entry)
    except ConfigError as error:
        return [{"name": name, "file": ", ".join(entry.value["file"]), "error": str(error)}]
    numbers = range(len(files)) if len(files) > 1 else [None]
    return [
        {"name": name, "number": number, **_series(one, standard)}
        for number, one in zip(numbers, files, strict=True)
    ]


def _series(entry: Entry, standard: int | None) -> dict[str, Any]:
    try:
        rows = read_rows(entry, standard)
        return {"column": rows.value.name, **_file(rows), **_values(rows)}
    except ConfigError as error:
        return {"file": entry.value["file"], "error": str(error)}


def _file(rows: DataRows) -> dict[str, Any]:
    """The facts that series of one file share."""
    table, time, places = rows.table, rows.time, np.flatnonzero(~np.isnan(rows.times))
    dates = None if time is None or time.is_numeric else time.dates_in(_zone(rows))
    offsets = [] if dates is None or dates.offsets is None else np.unique(dates.offsets).tolist()
    return {
        "file": rows.value.table,
        "separator": table.separator or None,
        "rows": len(rows.times),
        "first": rows.told(places[0]),
        "last": rows.told(places[-1]),
        "distance": usual_distance(rows.moments),
        "times": "seconds" if dates is None else "dates",
        "timezone": None if _zone(rows) is None else str(_zone(rows)),
        "offsets": [*map(offset_text, offsets if table.offset is None else [table.offset])],
        "left_out": int(np.isnan(rows.times).sum()),
    }


def _zone(rows: DataRows) -> Any:
    return rows.entry.value.get("timezone")


def _values(rows: DataRows) -> dict[str, Any]:
    times = rows.times[rows.is_known]
    return {
        "decimal_commas": rows.value.has_commas,
        "missing": int(np.isnan(rows.value.numbers[~np.isnan(rows.times)]).sum()),
        "longest_gap": float(np.diff(times).max()) if len(times) > 1 else None,
        "error": None,
    }


def data_as_text(facts: Mapping[str, Any]) -> Iterator[str]:
    """Format an overview of data for a terminal: each file once, with its columns below.

    Args:
        facts: Result of ``overview_of_data``.
    """
    if not facts["series"] and facts["error"] is None:
        return
    yield "\nData"
    if facts["error"] is not None:
        yield f"  {plain(facts['error'])}"
    if facts["standard_time"] is not None:
        yield f"  standard time: {plain(facts['standard_time'])}"
    lines: dict[str, list[str]] = {}
    for one in facts["series"]:
        line = one["file"] if "rows" not in one else _line_of_file(one)
        lines.setdefault(line, []).append(_line_of_series(one))
    for line, columns in lines.items():
        yield f"  {plain(line)}"
        yield from (f"    {plain(one)}" for one in columns)


def _line_of_file(one: Mapping[str, Any]) -> str:
    distance = one["distance"]
    parts = [
        f"{one['separator']} between cells" if one["separator"] else "",
        f"{one['rows']} rows, from {one['first']} to {one['last']}",
        "at uneven distances" if distance is None else f"{distance:g} s apart",
        f"offsets {', '.join(one['offsets'])}" if one["offsets"] else "",
        f"dates read as those of {one['timezone']}" if one["timezone"] else "",
        f"{one['left_out']} rows of 29 February left out" if one["left_out"] else "",
    ]
    return f"{one['file']}: {'; '.join(filter(None, parts))}"


def _line_of_series(one: Mapping[str, Any]) -> str:
    number = one.get("number")
    name = one["name"] if number is None else f"{one['name']}, file number {number}"
    if "rows" not in one:
        return f"{name}: {one['error']}"
    parts = [
        f"{name}: column {one['column']!r}",
        "decimal commas" if one["decimal_commas"] else "",
        f"{one['missing']} values missing" if one["missing"] else "",
        f"at most {one['longest_gap']:g} s from value to value" if one["missing"] else "",
    ]
    return ", ".join(filter(None, parts))


_SECONDS: Final = 10.0
"""Real time for the test of an FMU for which controllers are guessed."""

_SCHEMA_NAME: Final = "fmugym.schema.json"
_NO_DATA: Final = {"series": (), "error": None}
_SCHEMA_LINE: Final = f"#:schema ./{_SCHEMA_NAME}\n"
"""Line with the schema of the keys for editors; a file beside the task works offline, too."""


def add_info(commands: Commands) -> None:
    """Add ``info``."""
    text = "say what an FMU, a system or a dataset is; or repair an FMU that lacks a library"
    command = add_command(commands, "info", _info, text)
    command.add_argument(
        "fmu", metavar="FMU", help=f"or an SSP archive, a task file, or {MINARI}NAME for a dataset"
    )
    add_master(command)
    add_json(command)
    command.add_argument("--all", action="store_true", help="list local and other variables too")
    command.add_argument(
        "--filter",
        metavar="GLOB",
        help="list only variables with a matching name, of any causality; * is any text, "
        "? one character",
    )
    command.add_argument(
        "--repair",
        action="store_true",
        help="build what keeps the FMU from being loaded: a replacement of an old libgfortran, or "
        "a library for this machine from its source code; takes a C compiler",
    )
    command.add_argument(
        "--output",
        type=Path,
        metavar="PATH",
        help="with --repair: a new FMU (by default beside the old one), or the folder of the "
        "replacement (by default this one); of a dataset: a folder for its recordings (.npz)",
    )


def _info(arguments: argparse.Namespace) -> None:
    if arguments.fmu.startswith(MINARI):
        show_dataset(arguments, arguments.fmu.removeprefix(MINARI))
        return
    path = Path(arguments.fmu)
    if arguments.repair:
        _repair(arguments, FMU(path))
        return
    if arguments.output is not None:
        raise ConfigError("--output is for --repair and for datasets")
    model = find_model(path, arguments.master)
    wanted = {"everything": arguments.all, "pattern": arguments.filter}
    if isinstance(model, FMUSystem):
        facts, as_lines = overview_of_system(model, **wanted), as_text_of_system
    else:
        facts, as_lines = overview(model, **wanted), as_text
    if path.suffix.lower() == ".toml":
        facts["data"] = overview_of_data(Task.read(path))
    if arguments.json:
        say_json(facts)
    else:
        is_short = not (arguments.verbose or arguments.all or arguments.filter)
        text = as_lines(facts, is_short=is_short)
        say("\n".join([text, *data_as_text(facts.get("data", _NO_DATA))]))


def _repair(arguments: argparse.Namespace, fmu: FMU) -> None:
    if replaceable(fmu):
        _replace_libraries(arguments, fmu)
        return
    made = compile_fmu(fmu.path, arguments.output)
    say_result(arguments, {"output": made}, plain(f"{made}: compiled for {FMU(made).platform}"))


def _replace_libraries(arguments: argparse.Namespace, fmu: FMU) -> None:
    built = build_stand_in(fmu, arguments.output or Path())
    libraries, lines = [], []
    for one in built:
        libraries.append({"path": one.path, "functions": one.served, "without": one.lacking})
        lines.append(plain(f"{one.path}: {len(one.served)} functions"))
        without = (
            f"  without {name}: an FMU that calls it ends its process" for name in one.lacking
        )
        lines += map(plain, without)
    paths = [one.path for one in built]
    line = preload_line([*map(str, paths)])
    names = line.removeprefix("preload = ")
    lines.append(f"Put it into the task file, below [foreign]: {line}")
    lines.append(f'or into the config of a class: "foreign": {{"preload": {names}}}')
    say_result(arguments, {"preload": paths, "libraries": libraries}, "\n".join(lines))


def add_new(commands: Commands) -> None:
    """Add ``new``."""
    text = "write a task file for an FMU, or a Python file with a class, to be filled in"
    command = add_command(commands, "new", _new, text)
    command.add_argument(
        "--class", action="store_true", dest="as_class", help="a class instead of a task file"
    )
    command.add_argument("fmu", type=Path, metavar="FMU")
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new file, instead of standard output"
    )
    add_json(command)


def _new(arguments: argparse.Namespace) -> None:
    model, output = open_model(arguments.fmu), arguments.output
    folder = None if output is None else output.parent
    if arguments.as_class:
        skeleton = Skeleton(model, folder)
        text, notes = skeleton.text(), list(skeleton.notes())
    else:
        text, notes = _proposed(model, folder)
    if output is not None and not arguments.as_class:
        text = f"{_SCHEMA_LINE}{text}"
        shutil.copyfile(SCHEMA, output.parent / _SCHEMA_NAME)
    if output is not None or not arguments.json:
        write_text(text, output, [] if arguments.json else notes)
    if arguments.json:
        content = {"program": text} if arguments.as_class else {"task": tomllib.loads(text)}
        say_json({"output": output, **content, "notes": notes})


def _proposed(model: FMU, folder: Path | None) -> tuple[str, list[str]]:
    """The text of a task file, with controllers that a test of the FMU suggests; and notes."""
    proposal, controllers = Proposal(model, folder), dict[str, str]()
    notes = list(proposal.notes())
    task = Task.from_dict(tomllib.loads(Proposal(model).text()))
    try:
        controllers = controllers_for(partial(load, task, physical=True), _SECONDS)
    except FMUGymError as error:
        notes.append(f"no controller is guessed: {reason(error)}")
    return proposal.text(controllers), notes


def add_validate(commands: Commands) -> None:
    """Add ``validate``."""
    text = "run a few short episodes and say what is wrong with a task, and what to do about it"
    command = add_command(commands, "validate", _validate, text)
    add_task(command, ", or an FMU")
    add_json(command)


def _validate(arguments: argparse.Namespace) -> int:
    report = validate(maker_of(arguments.task, master=arguments.master, takes_fmu=True))
    say_result(arguments, report.as_dict(), report.as_text())
    return int(report.verdict == "error")
