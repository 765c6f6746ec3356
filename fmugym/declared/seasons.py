"""Beginnings of episodes in the year: dates, seasons and scenarios."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from fmugym.checks import Spellings
from fmugym.declared.entries import Entry
from fmugym.declared.file_lists import chosen_files, file_lists
from fmugym.distributions import Choice, DrawnColumn
from fmugym.errors import unknown_name

__all__ = ["Scenario", "held_out_times", "read_begin", "read_scenarios"]

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
