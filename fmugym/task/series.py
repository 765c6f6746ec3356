"""Values that depend on time only: columns of data, and schedules of a day."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fmugym.environment.forecasts import Span, distance_of
from fmugym.errors import ConfigError, shown
from fmugym.pool.pool import FloatArray
from fmugym.task.data_rows import read_rows
from fmugym.task.dates import DAY, YEAR
from fmugym.task.scenarios import files_of, variable_of
from fmugym.task.section_entries import Limits, read_limits
from fmugym.task.task_entries import Entry

__all__ = ["Series", "read_data", "read_schedule"]

_CLOCK: Final = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}))?")

_MOST_ROWS: Final = 20_000_000
"""Rows that are repeated up to a whole year, at most."""


@dataclass(frozen=True, eq=False)
class Series:
    """A function of time that repeats itself.

    Attributes:
        entry: Entry of the task.
        start: The time in seconds of the first row.
        period: Seconds after which it repeats.
        times: Seconds since ``start``, rising.
        values: The values at these times, and between them on straight lines.
        is_stepped: Whether the values jump, and hold until the next one.
        limits: For the observation space.
        unit: The unit of the values; None if none is declared.
        others: Series of the other files, if an episode draws one of several.
        variable: The episode variable with the number of the file; "" if there is only one.
    """

    entry: Entry
    start: float
    period: float
    times: FloatArray
    values: FloatArray
    is_stepped: bool
    limits: Limits
    unit: str | None
    others: tuple[Series, ...] = ()
    variable: str = ""

    @property
    def files(self) -> tuple[Series, ...]:
        """The series of each file, in the order of their numbers."""
        return (self, *self.others)

    @property
    def spans(self) -> tuple[Span, ...]:
        """Spans of time that its files cover."""
        return tuple(Span(one.start, one.period) for one in self.files)

    @property
    def points(self) -> FloatArray:
        """The places of all files in a table, and the values there; see ``Lookup``."""
        distance = distance_of(self.spans)
        places = [one.times + number * distance for number, one in enumerate(self.files)]
        for own in places:  # the rounding must leave them rising
            is_same = np.append(np.diff(own) == 0, False)
            own[is_same] = np.nextafter(own[is_same], -np.inf)
        return np.concatenate([*places, *(one.values for one in self.files)])

    @classmethod
    def of(
        cls, entry: Entry, times: FloatArray, values: FloatArray, period: float, is_stepped: bool
    ) -> Series:
        """Make a series of rows.

        Args:
            entry: Entry of the task; ``min``, ``max`` and ``unit`` are read from it.
            times: The times of the rows in seconds.
            values: Their values.
            period: Seconds after which the rows repeat.
            is_stepped: Whether a value holds until the next row.

        Raises:
            ConfigError: If the rows do not make a function of time.
        """
        _require_function(entry, times, values, period)
        start, times = float(times[0]), times - times[0]
        ends, wrapped = np.append(times[1:], period), np.append(values[1:], values[0])
        if is_stepped:  # hold each value until just before the next time
            ends = np.nextafter(ends, -np.inf)
            times = np.stack([times, np.maximum(times, ends)], axis=1).ravel()
            values = np.repeat(values, 2)
        else:
            times, values = np.append(times, ends[-1]), np.append(values, wrapped[-1])
        limits = read_limits(entry, float(values.min()), float(values.max()))
        unit = entry.value.get("unit")
        return cls(entry, start, period, times, values, is_stepped, limits, unit)


def _require_function(entry: Entry, times: FloatArray, values: FloatArray, period: float) -> None:
    if not len(times) or not np.isfinite(times).all() or not np.isfinite(values).all():
        raise entry.error("expected rows of finite times and values")
    steps = np.diff(times)
    if (steps <= 0).any():
        place = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise entry.error(f"the times must rise, but {times[place]:.10g} s comes twice")
    if period <= times[-1] - times[0]:
        raise entry.error(
            f"the period of {period:g} s must be longer than the rows, which last "
            f"{times[-1] - times[0]:g} s"
        )


def read_data(entry: Entry, standard: int | None = None) -> Series:
    """Read a column of a file or of each of several, or a list of values.

    Args:
        entry: Entry of the task.
        standard: The offset of the task's standard time in seconds east of UTC; None for the
            smallest offset of the rows.

    Returns:
        The series; its limits are those of all files.

    Raises:
        ConfigError: If the file or the column is missing, a cell is no number, times do not rise or
            do not tell what they mean, or values are missing for too long. The text says where.
    """
    if ("file" in entry.value) == ("values" in entry.value):
        text = "give either 'file' and 'column', or 'values' and 'step'"
        raise entry.lack(text, "file", "values")
    first, *others = (_read_file(one, standard) for one in files_of(entry))
    if not others:
        return first
    lows, highs = zip(first.limits, *(one.limits for one in others), strict=True)
    limits = min(lows), max(highs)
    return replace(first, limits=limits, others=tuple(others), variable=variable_of(entry))


def _read_file(entry: Entry, standard: int | None) -> Series:
    rows, table = read_rows(entry, standard), entry.value
    given = table.get("period")
    with entry.child("values" if "values" in table else "column").placing():
        rows.require_no_gap(None if given is not None else rows.period)
    times, values = rows.known()
    if given is None:
        with entry.placing():
            times, values, given = _in_whole_years(times, values, rows.period)
        if given > YEAR and rows.has_calendar:  # a year of the clock reads the first whole one
            times = times - YEAR * (times[0] > 0)
    return Series.of(entry, times, values, float(given), rows.is_stepped)


def _in_whole_years(
    times: FloatArray, values: FloatArray, period: float
) -> tuple[FloatArray, FloatArray, float]:
    """Rows that go beyond a year, repeated so that each of them has its time of the year.

    Returns:
        Times, values and the period, which are as they were where nothing goes beyond a year.
    """
    start, years = float(times[0]), max(1, math.ceil(period / YEAR - 1e-12))
    is_within = period < YEAR and (start <= 0 or start + period <= YEAR or YEAR % period == 0)
    if is_within or period == years * YEAR:
        return times, values, period
    shift = period if period < YEAR else (years - 1) * YEAR
    if years * YEAR / shift * len(times) > _MOST_ROWS:
        raise ConfigError("the rows go beyond the end of the year: give the 'period' they have")
    later, reached, end, parts = times, start + period, start + years * YEAR, [(times, values)]
    while reached < end:
        later = later + shift
        there = (reached <= later) & (later < end)
        parts.append((later[there], values[there]))
        reached += shift
    all_times, all_values = zip(*parts, strict=True)
    return np.concatenate(all_times), np.concatenate(all_values), years * YEAR


def read_schedule(point: Entry) -> Series:
    """Read a set point whose values hold from times of a day on, such as ``"06:00"``.

    Raises:
        ConfigError: If a time or a value does not fit.
    """
    entry = point.child("schedule")
    rows = sorted((_time_of_day(one), one.value) for one in entry.items().values())
    if not rows:
        raise entry.lack('expected times and values, such as { "06:00" = 21, "22:00" = 17 }')
    if rows[0][0] > 0:  # what holds at midnight began on the day before
        rows.insert(0, (0.0, rows[-1][1]))
    times, values = np.array(rows).T
    return Series.of(point, times, values, DAY, is_stepped=True)


def _time_of_day(entry: Entry) -> float:
    match = _CLOCK.fullmatch(entry.name)
    hours, minutes, seconds = (int(part or 0) for part in match.groups()) if match else (24, 0, 0)
    if hours > 23 or minutes > 59 or seconds > 59:
        raise entry.error(f"expected a time of day such as '06:00', got {shown(entry.name)}")
    return hours * 3600.0 + minutes * 60.0 + seconds
