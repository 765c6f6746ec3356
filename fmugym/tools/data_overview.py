"""Overview of a task's data, as read from the files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fmugym.declared import Task
from fmugym.declared.data_rows import DataRows, read_rows, usual_distance
from fmugym.declared.dates import offset_text
from fmugym.declared.entries import Entry
from fmugym.declared.file_lists import files_of
from fmugym.declared.standard_time import standard_time
from fmugym.errors import ConfigError, plain

__all__ = ["data_as_text", "overview_of_data"]


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
