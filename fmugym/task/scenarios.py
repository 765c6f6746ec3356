"""Scenarios of episodes: beginnings in the year, data files and fitted parameters.

An episode begins at one of several dates, or in a season or a scenario. It draws one file of each
list of data files, and one row of the parameters that a fit to logs of a plant has found.
"""

from __future__ import annotations

import glob
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple
from zipfile import BadZipFile

import numpy as np

from fmugym.checks import Spellings, require_regular
from fmugym.environment.distributions import Choice, DrawnColumn
from fmugym.errors import ConfigError, missing_file, shown, unknown_name
from fmugym.task.task_entries import Entry

__all__ = [
    "FileLists",
    "Scenario",
    "chosen_files",
    "file_lists",
    "files_of",
    "held_out_times",
    "listed_files",
    "read_begin",
    "read_fitted",
    "read_scenarios",
    "variable_of",
]

_SHARED: Final = "file number"
"""The episode variable with the place of the file in all lists that share it."""

FileLists = Mapping[str, Sequence[Sequence[str]]]
"""By episode variable, the files that belong to each of its values."""


def listed_files(entry: Entry) -> list[str]:
    """Paths of the files of a series; files that fit a pattern come in the order of their names.

    Raises:
        ConfigError: If there is none, or one comes twice.
    """
    file = entry.child("file")
    given = file.value if isinstance(file.value, list) else [file.value]
    paths = [path for one in given if one is not None for path in _fitting(file, one)]
    if not paths:
        raise file.error("expected at least one file")
    twice = next((path for path in paths if paths.count(path) > 1), None)
    if twice is not None:
        raise file.error(f"{shown(twice)} is listed twice")
    return paths


def _is_pattern(path: str) -> bool:
    return glob.has_magic(path) and not os.path.exists(path)


def _fitting(entry: Entry, path: str) -> list[str]:
    if not _is_pattern(path):
        return [path]
    found = sorted(filter(os.path.isfile, glob.glob(path, recursive=True)))
    if not found:
        raise entry.error(missing_file("file", Path(path), f"*{Path(path).suffix}"))
    return found


def files_of(entry: Entry) -> list[Entry]:
    """The same declaration of a series with each of its files alone; itself if it has none.

    Raises:
        ConfigError: As ``listed_files``.
    """
    if "file" not in entry.value:
        return [entry]
    return [replace(entry, value={**entry.value, "file": one}) for one in listed_files(entry)]


def variable_of(entry: Entry) -> str:
    """The episode variable with the number of a series' file."""
    return f"{_SHARED} of {entry.name}" if entry.value["draw"] == "own" else _SHARED


def file_lists(root: Entry) -> FileLists:
    """Lists of files of a task, and the distributions that draw one for each episode.

    Raises:
        ConfigError: If lists that share their number differ in their lengths.
    """
    lists: dict[str, dict[str, list[str]]] = {}
    for name, entry in root.child("data").items().items():
        given = entry.value.get("file") or []
        if len(given) > 1 or any(map(_is_pattern, filter(None, given))):
            _add(lists.setdefault(variable_of(entry), {}), name, entry)
    rows = {variable: [*zip(*own.values(), strict=True)] for variable, own in lists.items()}
    return {variable: own for variable, own in rows.items() if len(own) > 1}


def _add(lists: dict[str, list[str]], name: str, entry: Entry) -> None:
    paths = listed_files(entry)
    for other, known in lists.items():
        if len(known) != len(paths):
            raise entry.child("file").error(
                f"{name!r} has {len(paths)} files, but {other!r} has {len(known)}, and an episode "
                "takes files of one place in their lists. Let one draw by itself: "
                'draw = "own"'
            )
    lists[name] = paths


def chosen_files(entry: Entry, lists: FileLists) -> dict[str, int]:
    """The numbers of files that are chosen by their names.

    Args:
        entry: The names; each is the end of a path.
        lists: Has the files.

    Returns:
        The numbers by episode variable.

    Raises:
        ConfigError: If no file, or more than one of a list, has a name.
    """
    chosen: dict[str, int] = {}
    for one in entry.elements():
        with one.placing():
            for variable, number in _numbers_of(one.value, lists).items():
                if chosen.setdefault(variable, number) != number:
                    raise ConfigError(f"{shown(one.value)} is of another place in its list")
    return chosen


def _numbers_of(name: str, lists: FileLists) -> dict[str, int]:
    numbers: dict[str, int] = {}
    for variable, rows in lists.items():
        found = [i for i, row in enumerate(rows) if any(_ends_with(path, name) for path in row)]
        if len(found) > 1:
            raise ConfigError(
                f"{shown(name)} is the name of {len(found)} files of a list: say more of its path"
            )
        if found:
            numbers[variable] = found[0]
    if not numbers:
        known = {Path(path).name for rows in lists.values() for row in rows for path in row}
        raise unknown_name("file of a list", name, sorted(known))
    return numbers


def _ends_with(path: str, name: str) -> bool:
    parts = Path(name).parts
    return Path(path).parts[-len(parts) :] == parts


def read_fitted(entry: Entry) -> dict[str, DrawnColumn]:
    """Read a file of ``fmugym.records.log_fit.write_rows``.

    Args:
        entry: The path.

    Returns:
        By the names of the FMU, the values in its units.

    Raises:
        ConfigError: If it is no such file; the text says where the task names it.
    """
    path = entry.path()
    with entry.placing():
        try:
            require_regular(path)
            with np.load(path, allow_pickle=False) as file:
                names, rows = np.atleast_1d(file["names"]).tolist(), file["rows"]
        except FileNotFoundError:
            raise ConfigError(f"there is no file {shown(str(path))}") from None
        except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile):
            raise _not_fitted(path) from None
        is_table = rows.ndim == 2 and rows.dtype.kind == "f" and rows.shape[1] == len(names)
        if not (is_table and rows.size and np.isfinite(rows).all()):
            raise _not_fitted(path)
    columns = zip(names, rows.T.tolist(), strict=True)
    return {str(name): DrawnColumn(values, table=str(path)) for name, values in columns}


def _not_fitted(path: object) -> ConfigError:
    return ConfigError(
        f"{shown(str(path))} is no file that 'fmugym fit' has written: it needs 'names', and "
        "'rows' of finite numbers with a column for each"
    )


_YEAR: Final = 365 * 86400.0
_MOST_STARTS: Final = 10_000
_MOST_ROWS: Final = 200_000
"""Beginnings in each of the files that scenarios name, at most."""


class Scenario(NamedTuple):
    """A named part of the year, for the evaluation of agents.

    Attributes:
        start: When it begins, in seconds since the beginning of the year.
        length: Length in seconds.
        files: The numbers of its files, by their episode variables; of others it has any.
    """

    start: float
    length: float
    files: Mapping[str, int] = MappingProxyType({})

    def start_after(self, warm_up: float) -> float:
        """Start time of an FMU before the scenario's warm-up, at least 0."""
        return self.start - warm_up if self.start >= warm_up else (self.start - warm_up) % _YEAR

    def overlaps(self, start: float, length: float, files: Mapping[str, int]) -> bool:
        """Whether an episode shares time with it, in this or the next year, and files."""
        return self.files.items() <= files.items() and any(
            start < self.start + shift + self.length and self.start + shift < start + length
            for shift in (-_YEAR, 0.0, _YEAR)
        )


def read_scenarios(root: Entry) -> dict[str, Scenario]:
    """Read the scenarios of a task.

    Args:
        root: The table of all keys.
    """
    found, lists = {}, file_lists(root)
    for name, entry in root.child("scenarios").items().items():
        with entry.noting():
            start, length = (entry.required(key).value for key in ("start", "length"))
            found[name] = Scenario(start, length, chosen_files(entry.child("file"), lists))
    return found


def read_begin(
    entry: Entry,
    scenarios: Mapping[str, Scenario],
    length: float,
    before: float = 0.0,
    files: Mapping[str, Sequence[int]] = MappingProxyType({}),
) -> tuple[Any, dict[str, Any]]:
    """Read when episodes begin, and in which files of data.

    Args:
        entry: A time or date, a distribution of seconds, a list of times and dates, or a season.
        scenarios: Scenarios that a season may exclude.
        length: The length of an episode in seconds; 0 if it has no limit.
        before: The length of a warm-up with the data of the time before the beginning.
        files: The numbers of files from which an episode draws one, by episode variable.

    Returns:
        The time of data, or the start time of the FMU: seconds since the beginning of the year, or
        a distribution of them. Distributions of the numbers of files. What depends on each other
        comes first, and is drawn together.

    Raises:
        ConfigError: If it is none of these, or a season leaves no time for an episode.
    """
    season, alone = entry.value, {name: _one_of(numbers) for name, numbers in files.items()}
    if not isinstance(season, Mapping):
        return season, alone
    starts, excluded = list(_starts(entry)), _excluded(entry, scenarios)
    named = [n for n in files if len(files[n]) > 1 and any(n in one.files for one in excluded)]
    if len(starts) * math.prod(len(files[name]) for name in named) > _MOST_ROWS:
        raise entry.error(f"a season has at most {_MOST_ROWS} beginnings in all files")
    fixed = {name: numbers[0] for name, numbers in files.items() if len(numbers) == 1}
    free: list[tuple[float, ...]] = []
    for start, numbers in product(starts, [*product(*(files[name] for name in named))]):
        own = fixed | dict(zip(named, numbers, strict=True))
        if not any(one.overlaps(start - before, before + length, own) for one in excluded):
            free.append((start, *numbers))
    if not free:
        raise entry.error("no day of the season is left for an episode")
    if not named:
        return Choice([start for (start,) in free]), alone
    begin, *columns = (DrawnColumn(one, table="beginnings") for one in zip(*free, strict=True))
    drawn = dict(zip(named, columns, strict=True))
    return begin, drawn | {name: one for name, one in alone.items() if name not in named}


def _one_of(numbers: Sequence[int]) -> Any:
    return numbers[0] if len(numbers) == 1 else Choice(numbers)


def _starts(entry: Entry) -> Iterator[float]:
    """The possible beginnings in a season, which may go over the turn of the year."""
    first, last, step = (entry.required(key).value for key in ("from", "to", "step"))
    last += _YEAR if last < first else 0.0
    if (last - first) / step > _MOST_STARTS:
        raise entry.error(
            f"a season has from 1 to {_MOST_STARTS} beginnings, the step is {step:g} s"
        )
    for index in range(math.floor((last - first) / step + 1e-9) + 1):
        yield (first + index * step) % _YEAR


def _excluded(entry: Entry, scenarios: Mapping[str, Scenario]) -> list[Scenario]:
    names = entry.value["exclude"]
    if list(names) == ["scenarios"]:
        return list(scenarios.values())
    spellings, found = Spellings("scenario", scenarios), []
    for name in names:
        with entry.child("exclude").placing():
            own = spellings.find(name)
        if own is not None:
            found.append(scenarios[own])
        elif not entry.mistakes.explain(("scenarios", name)):
            raise entry.child("exclude").error(unknown_name("scenario", name, scenarios))
    return found


def held_out_times(root: Entry) -> list[Scenario]:
    """Times of the year without training episodes: scenarios, and days outside of the season.

    Args:
        root: The task outside of its scenarios.
    """
    found = list(read_scenarios(root).values())
    begins = (root.child(name).value for name in ("clock", "start_time"))
    for season in (one for one in begins if isinstance(one, Mapping)):
        length = (season["to"] - season["from"]) % _YEAR + (root.child("episode_length").value or 0)
        if length < _YEAR:
            found.append(Scenario(season["from"] + length, _YEAR - length))
    return found
