"""Dates of rows, time zones, and the seconds of a year of the clock.

A year of the clock has 365 days and no daylight saving time. Arrays of moments are microseconds
since the beginning of 1970.
"""

from __future__ import annotations

import datetime
import re
import zoneinfo
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.pool.pool import FloatArray

__all__ = [
    "DAY",
    "HOUR",
    "LOCAL_TIME_ADVICE",
    "REGULAR",
    "YEAR",
    "Dates",
    "IntArray",
    "moment_of_year",
    "offset_text",
    "shown_date",
    "standard_offset",
    "zone_of",
]

IntArray = npt.NDArray[np.int64]

REGULAR: Final = 0.9
"""The part of distances that are equal in rows that count as regular."""

HOUR: Final = 3600.0
DAY: Final = 86400.0
YEAR: Final = 365 * DAY

_SECOND: Final = 1_000_000
_HOUR: Final = 3600 * _SECOND
_DAY: Final = 24 * _HOUR

_OFFSET: Final = re.compile(r"([+-])(\d{2}):?(\d{2})")
_LARGEST_OFFSET: Final = 24 * 3600
_LEAP_DAY: Final = 59
"""The number of 29 February in its year, from 0 on."""

_YEAR_OF_RULES: Final = 2025
"""The year whose winter and summer tell the standard time of a zone."""

_MONTHS_OF_SPRING: Final = (3, 4, 9, 10, 11)
"""Months in which clocks are set forward, in the north and in the south."""

Told = Callable[[int], str]
"""Describes the place of a row by its index."""

LOCAL_TIME_ADVICE: Final = (
    "If these are local times with daylight saving time, say of which zone: "
    'timezone = "Europe/Berlin"; if they are not, the offset: timezone = "+01:00"'
)


def zone_of(what: str, value: Any) -> datetime.tzinfo:
    """Return the time zone of a name, such as ``"Europe/Berlin"``, or of an offset.

    Args:
        what: The name of the value, for the error.
        value: A name of the tz database, ``"+01:00"``, or an object of Python's ``datetime``.

    Raises:
        ConfigError: If there is no such zone.
    """
    if isinstance(value, datetime.tzinfo):
        return value
    if not isinstance(value, str):
        raise ConfigError(
            f"{what} must be a time zone such as 'Europe/Berlin' or '+01:00', got {shown(value)}"
        )
    if value in ("UTC", "Z"):
        return datetime.UTC
    if match := _OFFSET.fullmatch(value):
        seconds = int(match[2]) * 3600 + int(match[3]) * 60
        if seconds < _LARGEST_OFFSET and int(match[3]) < 60 and value.isascii():
            sign = -1 if match[1] == "-" else 1
            return datetime.timezone(datetime.timedelta(seconds=sign * seconds))
    try:
        return zoneinfo.ZoneInfo(value)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        raise _unknown_zone(value) from None


def _unknown_zone(name: str) -> ConfigError:
    known = sorted(zoneinfo.available_timezones())
    if known:
        return unknown_name("time zone", name, known)
    return ConfigError(
        f"unknown time zone {shown(name)}: this machine has none by name. Install the package "
        "tzdata, or give an offset such as '+01:00'"
    )


def standard_offset(zone: datetime.tzinfo) -> int:
    """The offset of a zone without daylight saving time, in seconds east of UTC."""
    days = (datetime.datetime(_YEAR_OF_RULES, month, 1) for month in (1, 7))
    return min(_seconds(zone.utcoffset(day)) for day in days)


def offset_text(offset: int) -> str:
    """An offset in seconds east of UTC as ``+01:00``."""
    hours, minutes = divmod(abs(offset) // 60, 60)
    return f"{'-' if offset < 0 else '+'}{hours:02d}:{minutes:02d}"


def shown_date(moment: int) -> str:
    """A moment as ``2023-12-31 15:00``, with seconds and their parts if it has some."""
    text = str(np.datetime64(int(moment), "us")).replace("T", " ")
    return re.sub(r":00$", "", re.sub(r"\.?0{1,6}$", "", text) if "." in text else text)


def _seconds(offset: datetime.timedelta | None) -> int:
    return 0 if offset is None else round(offset.total_seconds())


def moment_of_year(moment: datetime.datetime) -> float:
    """Seconds from the beginning of its year of 365 days; 29 February repeats the day before."""
    seconds, is_leap_day = _of_year(_walls([moment]))
    return float(seconds[0] - DAY * is_leap_day[0])


def _of_year(walls: IntArray) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Seconds since the first moment's year began, in years of 365 days, and which are left out."""
    days, within = np.divmod(walls, _DAY)
    dates = days.astype("M8[D]")
    years = dates.astype("M8[Y]")
    first, number = years.astype("M8[D]").astype(np.int64), years.astype(np.int64)
    is_long = (years + 1).astype("M8[D]").astype(np.int64) - first == 366
    day = days - first
    is_leap_day = is_long & (day == _LEAP_DAY)
    day -= is_long & (day > _LEAP_DAY)
    return (((number - number[0]) * 365 + day) * _DAY + within) / _SECOND, is_leap_day


@dataclass(frozen=True, eq=False)
class Dates:
    """The dates of rows.

    Attributes:
        walls: Local times without offsets, shape (n,).
        offsets: Seconds east of UTC, shape (n,); None if the dates do not tell them.
    """

    walls: IntArray
    offsets: IntArray | None = None

    @classmethod
    def of(cls, cells: Sequence[Any], told: Told) -> Dates:
        """Read dates of texts in ISO 8601, or of objects of Python's ``datetime``.

        Raises:
            ConfigError: If one is none, or some have an offset and others have not.
        """
        try:
            dates = [*map(datetime.datetime.fromisoformat, cells)]
        except (TypeError, ValueError):
            dates = [_date(cell, i, told) for i, cell in enumerate(cells)]
        zones = [*map(attrgetter("tzinfo"), dates)]
        if not any(zone is not None for zone in zones):
            return cls(_walls(dates))
        if None in zones:
            place = next(i for i, one in enumerate(zones) if (one is None) != (zones[0] is None))
            has, had = ("no", "an") if zones[place] is None else ("an", "no")
            raise ConfigError(
                f"{told(place)}: {dates[place]} has {has} offset from UTC, but {dates[0]} has "
                f"{had} one: give one to all rows, or to none"
            )
        return cls(_walls(dates), _offsets(dates, zones))

    @classmethod
    def of_instants(cls, instants: IntArray, zone: datetime.tzinfo) -> Dates:
        """Make dates of moments in UTC, as a zone shows them."""
        changes, offsets = _changes(zone, instants)
        own = offsets[np.searchsorted(changes, instants, side="right")]
        return cls(instants + own * _SECOND, own)

    def localized(self, zone: datetime.tzinfo, told: Told) -> Dates:
        """Give a zone's offsets to dates without an offset.

        Rows of an hour that the clock shows twice are told apart by their order.

        Raises:
            ConfigError: If a date does not exist there, or the order does not tell what it means.
        """
        changes, offsets = _changes(zone, self.walls)
        befores, afters = offsets[:-1], offsets[1:]
        lows = changes + np.minimum(befores, afters) * _SECOND
        highs = changes + np.maximum(befores, afters) * _SECOND
        own = offsets[np.searchsorted(highs, self.walls, side="right")]
        for low, high, before, after in zip(lows, highs, befores, afters, strict=True):
            between = np.flatnonzero((low <= self.walls) & (self.walls < high))
            if len(between) and after > before:
                raise ConfigError(
                    f"{told(between[0])}: {shown_date(self.walls[between[0]])} does not exist in "
                    f"{zone}: clocks are set forward there"
                )
            for rows in _runs(between):
                own[rows[self._switch(rows, zone, told) :]] = after
        return Dates(self.walls, own)

    def _switch(self, rows: IntArray, zone: datetime.tzinfo, told: Told) -> int:
        """Number of rows in the first pass of an hour that comes twice."""
        falls = np.flatnonzero(np.diff(self.walls[rows]) <= 0)
        if len(falls) == 1:
            return int(falls[0]) + 1
        how = "goes back more than once" if len(falls) else "does not come again"
        raise ConfigError(
            f"{told(rows[0])}: {shown_date(self.walls[rows[0]])} comes twice in {zone}, and the "
            f"order of rows does not tell which one it is: the time {how}. Give offsets from UTC"
        )

    @property
    def smallest_offset(self) -> int | None:
        """The smallest offset, in seconds east of UTC; None if no date tells one."""
        return None if self.offsets is None else int(self.offsets.min())

    def at(self, standard: int | None) -> Dates:
        """Return the dates as a clock with another offset shows them, in seconds east of UTC."""
        if self.offsets is None or standard is None:
            return self
        walls = self.walls + (standard - self.offsets) * _SECOND
        return Dates(walls, np.full_like(self.offsets, standard))

    def seconds(self) -> FloatArray:
        """Seconds since the beginning of the first row's year; NaN on 29 February."""
        seconds, is_leap_day = _of_year(self.walls)
        return np.where(is_leap_day, np.nan, seconds)

    def require_no_daylight_saving(self, told: Told) -> None:
        """Refuse dates without offsets in which an hour of daylight saving time is missing.

        Raises:
            ConfigError: If an hour is missing on a Sunday on which clocks are set forward.
        """
        distances = np.diff(self.walls)
        if self.offsets is not None or not len(distances):
            return
        usual = int(np.median(distances))
        is_regular = usual <= _HOUR and np.mean(distances == usual) >= REGULAR
        for place in np.flatnonzero(distances == usual + _HOUR) if is_regular else ():
            missing = np.datetime64(int(self.walls[place]) + usual, "us").item()
            is_spring = missing.month in _MONTHS_OF_SPRING and missing.weekday() == 6
            if is_spring and missing.hour < 4:
                raise ConfigError(
                    f"{told(int(place) + 1)}: {shown_date(self.walls[place + 1])} follows "
                    f"{shown_date(self.walls[place])}, an hour is missing. {LOCAL_TIME_ADVICE}"
                )


def _walls(dates: Sequence[datetime.datetime]) -> IntArray:
    """Local times without their offsets; numpy takes five times as long for many."""
    days = np.fromiter(map(datetime.datetime.toordinal, dates), np.int64, len(dates))
    walls = (days - datetime.date(1970, 1, 1).toordinal()) * _DAY
    lengths = {"hour": _HOUR, "minute": 60 * _SECOND, "second": _SECOND, "microsecond": 1}
    for name, length in lengths.items():
        walls += length * np.fromiter(map(attrgetter(name), dates), np.int64, len(dates))
    return walls


def _offsets(
    dates: Sequence[datetime.datetime], zones: Sequence[datetime.tzinfo | None]
) -> IntArray:
    """The offsets of dates in seconds, each of which has one."""
    fixed = {zone: None if zone is None else zone.utcoffset(None) for zone in {*zones}}
    if None in fixed.values():  # zones whose offset depends on the date
        return np.array([_seconds(date.utcoffset()) for date in dates])
    seconds = {zone: _seconds(offset) for zone, offset in fixed.items()}
    return np.array([seconds[zone] for zone in zones])


def _date(cell: Any, index: int, told: Told) -> datetime.datetime:
    if isinstance(cell, datetime.datetime) and cell == cell:  # NaT is not
        return cell
    if isinstance(cell, datetime.date) and cell == cell:
        return datetime.datetime(cell.year, cell.month, cell.day)
    if isinstance(cell, str):
        try:
            return datetime.datetime.fromisoformat(cell.strip())
        except ValueError:
            pass
    expected = "seconds, or a date such as 2023-12-31 15:00"
    raise ConfigError(f"{told(index)}: expected {expected}, got {shown(cell)}")


def _runs(rows: IntArray) -> list[IntArray]:
    """Indices in parts that follow each other without a gap."""
    return np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1) if len(rows) else []


def _changes(zone: datetime.tzinfo, moments: IntArray) -> tuple[IntArray, IntArray]:
    """Changes of a zone's offset near some moments, with the offsets before and after."""
    near = np.unique(np.unique(moments // _DAY)[:, None] + np.arange(-2, 3))
    try:
        offsets = [_offset(zone, int(day) * _DAY) for day in near]
        places = [i for i in range(1, len(near)) if offsets[i] != offsets[i - 1]]
        changes = [_change(zone, int(near[i - 1]) * _DAY, int(near[i]) * _DAY) for i in places]
    except (OverflowError, ValueError):
        raise ConfigError("a date is too far from today for a time zone") from None
    return np.array(changes, np.int64), np.array([offsets[0], *(offsets[i] for i in places)])


def _change(zone: datetime.tzinfo, low: int, high: int) -> int:
    """The moment between two others at which the offset of a zone changes."""
    before = _offset(zone, low)
    while high - low > _SECOND:
        middle = (low + high) // (2 * _SECOND) * _SECOND
        low, high = (middle, high) if _offset(zone, middle) == before else (low, middle)
    return high


def _offset(zone: datetime.tzinfo, moment: int) -> int:
    """The offset of a zone at a moment in UTC, in seconds."""
    start = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    there = (start + datetime.timedelta(microseconds=moment)).astimezone(zone)
    return _seconds(there.utcoffset())
