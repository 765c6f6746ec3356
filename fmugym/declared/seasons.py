"""When in a year an episode begins: dates, seasons and scenarios."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from fmugym.checks import Spellings
from fmugym.declared.entries import Entry
from fmugym.distributions import Choice
from fmugym.errors import unknown_name

__all__ = ["Scenario", "held_out_times", "read_begin", "read_scenarios"]

_YEAR: Final = 365 * 86400.0
_MOST_STARTS: Final = 10_000


class Scenario(NamedTuple):
    """A named part of the year, for the evaluation of agents.

    Attributes:
        start: When it begins, in seconds since the beginning of the year.
        length: How long it is, in seconds.
    """

    start: float
    length: float

    def start_after(self, warm_up: float) -> float:
        """When an FMU has to begin so that the scenario follows its warm-up, at least 0."""
        return self.start - warm_up if self.start >= warm_up else (self.start - warm_up) % _YEAR

    def overlaps(self, start: float, length: float) -> bool:
        """Whether an episode shares time with it, in this or the next year."""
        return any(
            start < self.start + shift + self.length and self.start + shift < start + length
            for shift in (-_YEAR, 0.0, _YEAR)
        )


def read_scenarios(section: Entry) -> dict[str, Scenario]:
    """Read the scenarios of a task."""
    found = {}
    for name, entry in section.items().items():
        with entry.noting():
            found[name] = Scenario(entry.required("start").value, entry.required("length").value)
    return found


def read_begin(
    entry: Entry, scenarios: Mapping[str, Scenario], length: float, before: float = 0.0
) -> Any:
    """Read when episodes begin: the time of data, or the start time of the FMU.

    Args:
        entry: A time or date, a distribution of seconds, a list of times and dates, or a season.
        scenarios: What a season may exclude.
        length: The length of an episode in seconds; 0 if it has no limit.
        before: The length of a warm-up with the data of the time before the beginning.

    Returns:
        Seconds since the beginning of the year, or a distribution of them.

    Raises:
        ConfigError: If it is none of these, or a season leaves no time for an episode.
    """
    season = entry.value
    if not isinstance(season, Mapping):
        return season
    starts = list(_starts(entry))
    excluded = _excluded(entry, scenarios)
    span = before + length
    free = [s for s in starts if not any(one.overlaps(s - before, span) for one in excluded)]
    if not free:
        raise entry.error("no day of the season is left for an episode")
    return Choice(free)


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
    """When in a year a task has no episodes but those of its scenarios: in these, and off season.

    Args:
        root: The task outside of its scenarios.
    """
    found = list(read_scenarios(root.child("scenarios")).values())
    begins = (root.child(name).value for name in ("clock", "start_time"))
    for season in (one for one in begins if isinstance(one, Mapping)):
        length = (season["to"] - season["from"]) % _YEAR + (root.child("episode_length").value or 0)
        if length < _YEAR:
            found.append(Scenario(season["from"] + length, _YEAR - length))
    return found
