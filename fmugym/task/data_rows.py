"""Rows of data: times on the clock of a task, and values, some of which may be missing.

The clock of a task shows standard time: it has one offset from UTC, throughout the year.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.checks import Spellings, check_path
from fmugym.errors import ConfigError, missing_file, shown
from fmugym.pool.pool import FloatArray
from fmugym.task.data_files import read_tables
from fmugym.task.data_tables import DataColumn, DataTable
from fmugym.task.dates import (
    DAY,
    HOUR,
    LOCAL_TIME_ADVICE,
    REGULAR,
    Dates,
    offset_text,
    standard_offset,
)
from fmugym.task.scenarios import files_of
from fmugym.task.task_entries import Entry

__all__ = [
    "DataRows",
    "StandardTime",
    "read_rows",
    "standard_time",
    "usual_distance",
    "utc_offsets_of",
]

_SAME: Final = 1e-6
"""Distances that differ by less, as a part of them, are equal."""


@dataclass(frozen=True, eq=False)
class DataRows:
    """Rows of data as they stand in a file or a list.

    Attributes:
        entry: Entry of the task.
        table: The table that they are from.
        value: The column of values; NaN is an empty cell.
        time: Column of times; None if there is only a distance between rows.
        dates: The times on the standard time; None if they are seconds.
        times: Seconds since the beginning of the year, shape (n,); NaN on 29 February.
    """

    entry: Entry
    table: DataTable
    value: DataColumn
    time: DataColumn | None
    dates: Dates | None
    times: FloatArray

    @property
    def is_stepped(self) -> bool:
        """Whether a value holds until the next row."""
        return bool(self.entry.value["interpolation"] == "previous")

    @property
    def has_calendar(self) -> bool:
        """Whether the times are dates or hours of weather, rather than any seconds."""
        return self.dates is not None or (self.time is not None and self.time.of_year)

    @cached_property
    def is_known(self) -> npt.NDArray[np.bool_]:
        """Mask of the rows with a time and a value, shape (n,)."""
        return ~np.isnan(self.times) & ~np.isnan(self.value.numbers)

    @property
    def moments(self) -> FloatArray:
        """The times of the rows that have one."""
        return self.times[~np.isnan(self.times)]

    @property
    def period(self) -> float:
        """Seconds after which they repeat: as the table says, or one more row than there are."""
        if self.table.period is not None:
            return self.table.period
        times = self.moments
        last = float(times[-1] - times[-2]) if len(times) > 1 else DAY
        usual = usual_distance(times)
        is_odd = usual is not None and abs(last - usual) > _SAME * usual
        return float(times[-1] - times[0]) + (usual if usual is not None and is_odd else last)

    def known(self) -> tuple[FloatArray, FloatArray]:
        """The times of values, and the values. A mean holds for the time before its row."""
        share = 1.0 if self.is_stepped else 0.5  # lines between means lead through the middle
        before = self.table.means.get(self.value.name, 0.0) * share
        return self.times[self.is_known] - before, self.value.numbers[self.is_known]

    def told(self, index: int) -> str:
        """Say which row has an index, and when it is."""
        if self.time is not None:
            return self.time.when(index)
        return f"row {self.value.rows[index]} ({self.times[index]:.10g} s)"

    def require_rising(self) -> None:
        """Refuse times that do not rise.

        Raises:
            ConfigError: With the rows, their times and the column.
        """
        kept = np.flatnonzero(~np.isnan(self.times))
        steps = np.diff(self.times[kept])
        if not len(kept):
            raise ConfigError("there is no row but of 29 February, which a year does not have here")
        if (steps > 0).all() or self.time is None:
            return
        place = int(np.flatnonzero(~(steps > 0))[0])
        is_local = self.dates is not None and self.dates.offsets is None
        hint = f". {LOCAL_TIME_ADVICE}" if is_local and steps[place] >= -HOUR else ""
        raise ConfigError(
            f"the times must rise, but in column {shown(self.time.name)} "
            f"{self.told(kept[place + 1])} is not above {self.told(kept[place])}{hint}"
        )

    def require_no_gap(self, period: float | None) -> None:
        """Refuse rows in which values are missing for too long.

        Args:
            period: Seconds after which the first row comes again; None if that is no matter.

        Raises:
            ConfigError: With the rows around the longest gap, and their times.
        """
        places, longest = np.flatnonzero(self.is_known), self.longest_gap
        if not len(places):
            raise ConfigError(self._missing)
        times = self.times[places]
        distances = np.diff(times) if period is None else np.diff(times, append=times[0] + period)
        if not len(distances) or distances.max() <= longest * (1 + _SAME):
            return
        place = int(distances.argmax())
        before, after = (self.told(places[i % len(places)]) for i in (place, place + 1))
        missing = "" if len(places) == len(self.moments) else f"{self._missing}: "
        raise ConfigError(
            f"{missing}between {before} and {after} there is no value of {self._named} "
            f"for {_length(distances[place])}, expected at most {_length(longest)}. If a line may "
            'lead across, say so: gaps = "interpolate", or the longest time, such as gaps = "1d"'
        )

    @property
    def _missing(self) -> str:
        total = len(self.moments)
        return f"{total - self.is_known.sum()} of {total} values of {self._named} are missing"

    @property
    def _named(self) -> str:
        file = f" of {self.value.table}" if self.value.table else ""
        return f"{shown(self.value.name)}{file}"

    @property
    def longest_gap(self) -> float:
        """The longest time from a value to the next one, in seconds.

        Twice the distance of rows that are regular, if lines lead from value to value.
        """
        given = self.entry.value.get("gaps")
        if given is not None:
            return float(given)
        if self.table.longest_gap is not None:
            return self.table.longest_gap
        usual = usual_distance(self.times[self.is_known]) or usual_distance(self.moments)
        return math.inf if usual is None or self.is_stepped else 2 * usual


def _length(seconds: float) -> str:
    """A duration in words."""
    for unit, length in (("days", DAY), ("hours", HOUR), ("minutes", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.6g} {unit}"
    return f"{seconds:.6g} s"


def usual_distance(times: FloatArray) -> float | None:
    """The distance of times in seconds, if it is equal in nine of ten rows; None otherwise."""
    distances = np.diff(times)
    if not len(distances):
        return None
    usual = float(np.median(distances))
    is_regular = np.mean(np.abs(distances - usual) <= _SAME * abs(usual)) >= REGULAR
    return usual if is_regular and usual > 0 else None


def read_rows(entry: Entry, standard: int | None = None) -> DataRows:
    """Read the rows of a file or of a list.

    Args:
        entry: Entry of the task.
        standard: The offset of the standard time in seconds east of UTC; None for the smallest
            offset of the rows.

    Raises:
        ConfigError: If the file or the column is missing, a cell is no number or no time, or times
            do not rise. The text says where.
    """
    table = _table(entry)
    value, time = _value_column(entry, table), _time_column(entry, table)
    with _placing(entry, "column", "values"):
        _require_finite(value)
    if time is None:
        times = np.arange(len(value.rows), dtype=np.float64) * entry.value["step"]
        return DataRows(entry, table, value, None, None, times)
    with _placing(entry, "time", "times"):
        dates, times = _on_standard_time(entry, table, time, standard)
        rows = DataRows(entry, table, value, time, dates, times)
        rows.require_rising()
    return rows


def _on_standard_time(
    entry: Entry, table: DataTable, time: DataColumn, standard: int | None
) -> tuple[Dates | None, FloatArray]:
    """The dates of rows, None for seconds, and the seconds of the year."""
    dates = _dates(entry, time)
    if dates is not None:
        dates = dates.at(dates.smallest_offset if standard is None else standard)
        return dates, dates.seconds()
    seconds = _seconds(time)
    if standard is None or table.offset is None:
        return None, seconds
    return None, seconds + (standard - table.offset)


@contextmanager
def _placing(entry: Entry, of_file: str, of_list: str) -> Iterator[None]:
    with entry.child(of_list if "values" in entry.value else of_file).placing():
        yield


def _dates(entry: Entry, time: DataColumn) -> Dates | None:
    """Read times as dates; None for seconds. Dates without an offset are in the declared zone."""
    zone = entry.value.get("timezone")
    if not time.is_numeric:
        return time.dates_in(zone)
    if zone is not None:
        raise entry.child("timezone").error("it is for dates, but the times are seconds")
    return None


def _seconds(time: DataColumn) -> FloatArray:
    seconds = time.numbers
    wrong = np.flatnonzero(~np.isfinite(seconds))
    if len(wrong):
        cell = time.cells[wrong[0]]
        raise ConfigError(f"{time.told(int(wrong[0]))}: expected a time, got {shown(cell)}")
    return seconds


def _require_finite(value: DataColumn) -> None:
    wrong = np.flatnonzero(np.isinf(value.numbers))
    if len(wrong):
        cell = value.cells[wrong[0]]
        raise ConfigError(f"{value.told(int(wrong[0]))}: expected a number, got {shown(cell)}")


def utc_offsets_of(entry: Entry) -> tuple[str, int | None, tuple[int, ...]]:
    """The offsets from UTC that data tell, in seconds.

    Args:
        entry: Entry of the task.

    Returns:
        The name of the file, the offset in its header or None, and those of its dates.

    Raises:
        ConfigError: As ``read_rows``.
    """
    table = _table(entry)
    time = _time_column(entry, table)
    dates = None if time is None else _dates(entry, time)
    own = () if dates is None or dates.offsets is None else np.unique(dates.offsets).tolist()
    return table.columns[0].table or entry.name, table.offset, tuple(own)


# Columns.


def _table(entry: Entry) -> DataTable:
    """The table that is meant; a file of rows has one only."""
    if "values" in entry.value:
        return _table_of_lists(entry)
    tables, name = _read_file(entry.child("file")), entry.child("table")
    if name.value is None and len(tables) == 1:
        return next(iter(tables.values()))
    if name.value is None:
        raise entry.error(f"name one of the tables as 'table': {', '.join(map(repr, tables))}")
    with name.placing():
        return tables[Spellings("table", tables).require(name.value)]


def _read_file(file: Entry) -> Mapping[str, DataTable]:
    path = check_path("file", file.value)
    try:
        with file.placing():
            return read_tables(path)
    except FileNotFoundError:
        raise file.error(missing_file("file", path, f"*{path.suffix}")) from None
    except OSError as error:
        raise file.error(f"{shown(str(path))} cannot be read: {error.strerror}") from None


def _table_of_lists(entry: Entry) -> DataTable:
    values, times, step = (entry.value.get(key) for key in ("values", "times", "step"))
    if not len(values):
        raise entry.error("expected at least one value")
    if (times is None) == (step is None):
        text = "give either the 'step' between the values, or their 'times'"
        raise entry.lack(text, "step", "times")
    if times is not None and len(times) != len(values):
        raise entry.child("times").error(f"there are {len(times)} times, but {len(values)} values")
    lists = {"values": values} if times is None else {"values": values, "times": times}
    rows = range(1, len(values) + 1)
    return DataTable([DataColumn("", name, cells, rows) for name, cells in lists.items()])


def _value_column(entry: Entry, table: DataTable) -> DataColumn:
    if "values" in entry.value:
        return table.find("values")
    column = entry.required("column")
    with column.placing():
        return table.find(column.value)


def _time_column(entry: Entry, table: DataTable) -> DataColumn | None:
    """The column of times; None if there is a step between rows."""
    if entry.value.get("step") is not None:
        return None
    if "values" in entry.value:
        return table.find("times")
    name = entry.child("time")
    with name.placing():
        found = table.find_time() if name.value is None else table.find(name.value)
    if found is None:
        text = "name the column with the times as 'time', or give the 'step' between rows"
        names = ", ".join(map(repr, table.names))
        raise entry.lack(f"{text}; there are: {names}", "time", "step")
    return found


class StandardTime(NamedTuple):
    """The standard time of a task.

    Attributes:
        offset: Its offset in seconds east of UTC; None if nothing tells it.
        origin: Source of the offset.
    """

    offset: int | None
    origin: str

    def __str__(self) -> str:
        if self.offset is None:
            return f"not given: {self.origin}"
        return f"{offset_text(self.offset)} ({self.origin})"


def standard_time(root: Entry) -> StandardTime:
    """Find the standard time of a task.

    It is what the key ``timezone`` says, or else the offset in the header of its weather, or else
    the smallest offset in its data.

    Args:
        root: The table of all keys.

    Raises:
        ConfigError: If only files tell it, and they differ.
    """
    given = root.child("timezone")
    if given.value is not None:
        return StandardTime(standard_offset(given.value), "by the key 'timezone'")
    told = [*_told(_data(root))]
    headers = [(file, header) for file, header, _ in told if header is not None]
    if headers:
        return _agreed(given, headers, "by the header of {}")
    smallest = [(file, min(offsets)) for file, _, offsets in told if offsets]
    for file, _, offsets in told:
        if offsets and max(offsets) - min(offsets) > HOUR:  # more than daylight saving time
            smallest.append((f"{file}, in some rows,", max(offsets)))
    if not smallest:
        return StandardTime(None, "dates have no offset from UTC")
    return _agreed(given, smallest, "the smallest offset in {}")


def _data(root: Entry) -> Iterator[Entry]:
    for entry in root.child("data").items().values():
        with suppress(ConfigError):  # whoever reads the data says what is wrong with them
            yield from files_of(entry)
    live = root.child("plant").child("data").items().values()
    yield from (entry for entry in live if "file" in entry.value)


def _told(data: Iterable[Entry]) -> Iterator[tuple[str, int | None, tuple[int, ...]]]:
    """Offsets that files tell; mistakes are reported by the reader of their data."""
    for entry in data:
        with suppress(ConfigError):
            yield utc_offsets_of(entry)


def _agreed(key: Entry, offsets: Sequence[tuple[str, int]], origin: str) -> StandardTime:
    """The standard time that all files tell."""
    file, offset = offsets[0]
    if len({one for _, one in offsets}) == 1:
        return StandardTime(offset, origin.format(file))
    listed = ", ".join(f"{name} has {offset_text(one)}" for name, one in dict.fromkeys(offsets))
    raise key.error(
        f"files differ in their offset from UTC (time zone): {listed}. Say which one is the "
        f'standard time: timezone = "{offset_text(offset)}"'
    )
