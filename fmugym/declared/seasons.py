"""When in a year an episode begins: dates, seasons and scenarios."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from fmugym.declared.entries import Entry
from fmugym.declared.quantities import duration
from fmugym.declared.values import number_or_distribution
from fmugym.distributions import Choice, is_distribution
from fmugym.errors import ConfigError, shown, unknown_name

__all__ = ["Scenario", "read_begin", "read_scenarios", "scenario_of"]

_SEASON_KEYS: Final = ("from", "to", "step", "exclude")
_SCENARIO_KEYS: Final = ("start", "length", "description")

_DAY: Final = 86400.0
_YEAR: Final = 365 * _DAY
_DATE: Final = re.compile(r"(?:\d{4}-)?(\d{2})-(\d{2})(?:[T ](\d{2}):(\d{2}))?")
_ANY_YEAR: Final = 2001  # without a leap day
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
    """Read the scenarios of a task.

    Raises:
        ConfigError: If one has no beginning or length.
    """
    if section.value is None:
        return {}
    return {name: _scenario(entry) for name, entry in section.items().items()}


def _scenario(entry: Entry) -> Scenario:
    entry.table(_SCENARIO_KEYS)
    length = entry.required("length").check(duration)
    return Scenario(_moment(entry.required("start")), length)


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
    value = entry.value
    if is_distribution(value) or (isinstance(value, Mapping) and "distribution" in value):
        return number_or_distribution(entry)
    if isinstance(value, list | tuple):
        with entry.placing():
            return Choice([_moment(one) for one in entry.elements()])
    if not isinstance(value, Mapping):
        return _moment(entry)
    starts = list(_starts(entry))
    excluded = [] if entry.child("exclude").value is None else _excluded(entry, scenarios)
    span = before + length
    free = [s for s in starts if not any(one.overlaps(s - before, span) for one in excluded)]
    if not free:
        raise entry.error("no day of the season is left for an episode")
    return Choice(free)


def _starts(entry: Entry) -> Iterator[float]:
    """The possible beginnings in a season, which may go over the turn of the year."""
    table = entry.table(_SEASON_KEYS)
    first, last = _moment(entry.required("from")), _moment(entry.required("to"))
    step = table["step"].check(duration) if "step" in table else _DAY
    last += _YEAR if last < first else 0.0
    if not step > 0 or (last - first) / step > _MOST_STARTS:
        raise entry.error(
            f"a season has from 1 to {_MOST_STARTS} beginnings, the step is {step:g} s"
        )
    for index in range(math.floor((last - first) / step + 1e-9) + 1):
        yield (first + index * step) % _YEAR


def _excluded(entry: Entry, scenarios: Mapping[str, Scenario]) -> list[Scenario]:
    names = entry.child("exclude")
    if names.value == "scenarios":
        return list(scenarios.values())
    chosen = [names] if isinstance(names.value, str) else names.elements()
    for name in chosen:
        if name.text() not in scenarios:
            raise name.error(unknown_name("scenario", name.value, scenarios))
    return [scenarios[name.text()] for name in chosen]


def _moment(entry: Entry) -> float:
    """Seconds since the beginning of a year of 365 days, of a duration or of a date."""
    value = entry.value
    if isinstance(value, datetime.date):  # TOML has dates of its own
        value = value.isoformat()[:16]
    if not isinstance(value, str) or "-" not in value:
        return entry.check(duration)
    match = _DATE.fullmatch(value)
    month, day, hour, minute = map(int, match.groups(default="0")) if match else (0, 0, 0, 0)
    try:
        date = datetime.datetime(_ANY_YEAR, month, day, hour, minute)
    except ValueError:
        raise entry.error(
            f"expected a date such as '01-15' or '01-15 06:00', got {shown(entry.value)}"
        ) from None
    return (date - datetime.datetime(_ANY_YEAR, 1, 1)).total_seconds()


def scenario_of(scenarios: Mapping[str, Scenario], name: str) -> Scenario:
    """Find a scenario by its name.

    Raises:
        ConfigError: If there is none of this name, with the nearest one.
    """
    if name not in scenarios:
        raise ConfigError(unknown_name("scenario", name, scenarios))
    return scenarios[name]
