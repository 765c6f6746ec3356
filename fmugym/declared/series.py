"""Values that depend on time only: columns of data, and schedules of a day."""

from __future__ import annotations

import codecs
import csv
import datetime
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.checks import check_integer, check_path, require_regular
from fmugym.declared.entries import Entry
from fmugym.declared.parts import Limits, read_limits
from fmugym.declared.weather import Cells, FloatArray, Table, read_modelica, read_weather
from fmugym.errors import ConfigError, missing_file, reading, reason, shown, unknown_name
from fmugym.extras import imported
from fmugym.signals import ordinary

__all__ = ["Series", "is_number", "read_csv", "read_data", "read_rows", "read_schedule"]

_DAY: Final = 86400.0
_CLOCK: Final = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}))?")
_NAMES_OF_TIME: Final = ("time", "datetime", "timestamp", "date")

_PARQUET: Final = (".parquet", ".pq")


@dataclass(frozen=True, eq=False)
class Series:
    """A function of time that repeats itself.

    Attributes:
        entry: Where it is declared.
        start: The time in seconds of the first row.
        period: Seconds after which it repeats.
        times: Seconds since ``start``, rising.
        values: The values at these times, and between them on straight lines.
        is_stepped: Whether the values jump, and hold until the next one.
        limits: For the observation space.
        unit: The unit of the values; None if none is declared.
    """

    entry: Entry
    start: float
    period: float
    times: FloatArray
    values: FloatArray
    is_stepped: bool
    limits: Limits
    unit: str | None

    @classmethod
    def of(
        cls, entry: Entry, times: FloatArray, values: FloatArray, period: float, is_stepped: bool
    ) -> Series:
        """Make a series of rows.

        Args:
            entry: Where it is declared; ``min``, ``max`` and ``unit`` are read from it.
            times: The times of the rows in seconds.
            values: Their values.
            period: Seconds after which the rows repeat.
            is_stepped: Whether a value holds until the next row.

        Raises:
            ConfigError: If the rows do not make a function of time.
        """
        _require_rising(entry, times, values, period)
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


def _require_rising(entry: Entry, times: FloatArray, values: FloatArray, period: float) -> None:
    if not len(times) or not np.isfinite(times).all() or not np.isfinite(values).all():
        raise entry.error("expected rows of finite times and values")
    steps = np.diff(times)
    if (steps <= 0).any():
        place = int(np.flatnonzero(steps <= 0)[0]) + 1
        raise entry.error(
            f"the times must rise, but {times[place]:g} s is not above the one before"
        )
    if period <= times[-1] - times[0]:
        raise entry.error(
            f"the period of {period:g} s must be longer than the rows, which last "
            f"{times[-1] - times[0]:g} s"
        )


def read_data(entry: Entry) -> Series:
    """Read a column of a file, or a list of values.

    Raises:
        ConfigError: If the file or the column is missing, or a cell is no number. The text says
            where.
    """
    table = entry.value
    if ("file" in table) == ("values" in table):
        text = "give either 'file' and 'column', or 'values' and 'step'"
        raise entry.lack(text, "file", "values")
    is_stepped = table["interpolation"] == "previous"
    rows = _rows_of_list(entry) if "values" in table else _rows_of_file(entry, is_stepped)
    times, values, period = rows
    if "period" in table:
        period = table["period"]
    elif period is None:  # one more row than there are
        period = times[-1] - times[0] + (times[-1] - times[-2] if len(times) > 1 else _DAY)
    return Series.of(entry, times, values, float(period), is_stepped)


def read_rows(entry: Entry) -> tuple[FloatArray, FloatArray]:
    """Read the rows of a file as they are now: times in seconds, and values.

    Raises:
        ConfigError: As ``read_data``.
    """
    times, values, _ = _rows_of_file(entry, entry.value["interpolation"] == "previous")
    return times, values


_Rows = tuple[FloatArray, FloatArray, float | None]
"""Times, values, and the period that a file gives."""


def _rows_of_list(entry: Entry) -> _Rows:
    """The values of a list or an array, and their times."""
    values, times, step = (entry.value.get(key) for key in ("values", "times", "step"))
    if not len(values):
        raise entry.error("expected at least one value")
    if (times is None) == (step is None):
        text = "give either the 'step' between the values, or their 'times'"
        raise entry.lack(text, "step", "times")
    if times is None:
        return _even_times(step, len(values)), values, None
    if len(times) != len(values):
        raise entry.child("times").error(f"there are {len(times)} times, but {len(values)} values")
    return times, values, None


def _even_times(step: float, count: int) -> FloatArray:
    return np.arange(count, dtype=np.float64) * step


def _rows_of_file(entry: Entry, is_stepped: bool) -> _Rows:
    table, column = _table(entry), entry.required("column")
    name = _name_of(column, table.columns)
    cells, step = table.columns[name], entry.value.get("step")
    if step is not None:
        return _even_times(step, len(cells)), _numbers(column, cells), None
    if table.period is None:
        values = _numbers(column, cells)
        return _times(entry, table.columns), values, None
    times = _times(entry, table.columns)
    # A mean holds for the time before its row; lines between means lead through the middle of it.
    times = times - table.means.get(name, 0.0) * (1.0 if is_stepped else 0.5)
    there = ~np.isnan(cells)
    _require_short_gaps(column, times[there], table.period, there)
    return times[there], _numbers(column, np.asarray(cells)[there]), table.period


def _table(entry: Entry) -> Table:
    """The table of a file that is meant. A file of rows has one only."""
    tables, name = _read_file(entry.child("file")), entry.child("table")
    if name.value is None and len(tables) == 1:
        return next(iter(tables.values()))
    if name.value is None:
        raise entry.error(f"name one of the tables as 'table': {', '.join(map(repr, tables))}")
    if name.value not in tables:
        raise name.error(unknown_name("table", name.value, tables))
    return tables[name.value]


def _name_of(column: Entry, columns: Mapping[str, Cells]) -> str:
    """The name of a column that is given by its name, or by its number from 1 on."""
    if isinstance(column.value, int):
        with column.placing():
            return list(columns)[check_integer("column", column.value, 1, len(columns)) - 1]
    if column.value not in columns:
        raise column.error(unknown_name("column", column.value, columns))
    return str(column.value)


def _require_short_gaps(
    column: Entry, times: FloatArray, period: float, there: npt.NDArray[np.bool_]
) -> None:
    """Refuse a column in which values are missing for more than a day in a row."""
    gaps = np.diff(times, append=times[:1] + period)
    longest = gaps.max() if len(gaps) else math.inf
    if longest > _DAY and not there.all():
        raise column.error(
            f"{np.sum(~there)} of {len(there)} values of {shown(column.value)} are missing, for "
            "more than a day at a time"
        )


def _numbers(entry: Entry, cells: Cells) -> FloatArray:
    try:
        numbers = np.array(cells, np.float64)
    except (TypeError, ValueError):
        numbers = np.full(len(cells), np.nan)
    if not np.isfinite(numbers).all():
        numbers = np.array([_cell(entry, i, text) for i, text in enumerate(cells)])
    return numbers


def _read_file(file: Entry) -> Mapping[str, Table]:
    """The tables of a file by name. Environments of one task read it once."""
    path = check_path("file", file.value)
    try:
        require_regular(path)
        status = path.stat()
        with file.placing():
            read = _read_parquet if path.suffix.lower() in _PARQUET else _read_text
            return read(path, status.st_mtime_ns, status.st_size)
    except FileNotFoundError:
        raise file.error(missing_file("file", path, f"*{path.suffix}")) from None
    except ordinary(OSError) as error:
        raise file.error(f"{shown(str(path))} cannot be read: {error.strerror}") from None


@lru_cache(maxsize=16)
def _read_parquet(path: Path, changed: int, size: int) -> Mapping[str, Table]:
    """Read a Parquet file, whose cells have types."""
    pyarrow, parquet = imported("pyarrow", "parquet"), imported("pyarrow.parquet", "parquet")
    try:
        table = parquet.ParquetFile(path).read()
    except ordinary(pyarrow.ArrowException, ValueError) as error:
        raise ConfigError(f"{path.name} is no Parquet file: {reason(error)}") from None
    if not table.num_rows:
        raise ConfigError(f"{path.name} has no rows")
    return {path.stem: Table({name: table[name].to_pylist() for name in table.column_names})}


@lru_cache(maxsize=16)
def _read_text(path: Path, changed: int, size: int) -> Mapping[str, Table]:
    """Read a file. Its first line tells what it is."""
    content = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    if content.startswith((b"#1", b"LOCATION,")):  # names of places have any encoding
        lines = [line.decode("latin-1") for line in content.splitlines()]
        if content.startswith(b"#1"):
            return read_modelica(path.name, lines)
        return {path.stem: read_weather(path.name, lines)}
    return {path.stem: Table(read_csv(path, content))}


def read_csv(path: Path, content: bytes) -> dict[str, tuple[str, ...]]:
    """Read the columns of a CSV file by their names.

    A semicolon separates cells where the first line has one.

    Args:
        path: The file, for errors.
        content: What it has.

    Raises:
        ConfigError: If it has no rows, they are not of one length, a cell has more than 128 KiB,
            or it is no text in UTF-8.
    """
    try:
        file = io.StringIO(content.decode("utf-8-sig"), newline="")
    except UnicodeDecodeError:
        raise ConfigError(f"{shown(str(path))} is not encoded in UTF-8") from None
    delimiter = ";" if ";" in file.readline() else ","
    file.seek(0)
    with reading(f"{path.name} is no table"):
        header, *rows = [row for row in csv.reader(file, delimiter=delimiter) if row] or [[]]
    for number_of_row, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise ConfigError(
                f"row {number_of_row} of {path.name} has {len(row)} cells, expected {len(header)}"
            )
    if not rows:
        raise ConfigError(f"{path.name} has no rows below its header")
    names = [name.strip() for name in header]
    return dict(zip(names, zip(*rows, strict=True), strict=True))


def _times(entry: Entry, rows: Mapping[str, Cells]) -> FloatArray:
    """The times of the rows: seconds, or dates, which count from the beginning of their year."""
    name = entry.child("time")
    if name.value is not None and name.value not in rows:
        raise name.error(unknown_name("column", name.value, rows))
    known = {column.lower(): column for column in rows}
    usual = next((known[word] for word in _NAMES_OF_TIME if word in known), None)
    column: str | None = usual if name.value is None else name.value
    if column is None:
        text = "name the column with the times as 'time', or give the 'step' between rows"
        raise entry.lack(f"{text}; there are: {', '.join(map(repr, rows))}", "time", "step")
    return _seconds(name, rows[column])


def _seconds(entry: Entry, cells: Cells) -> FloatArray:
    if is_number(cells[0]):
        return _numbers(entry, cells)
    dates = [_date(entry, i, cell) for i, cell in enumerate(cells)]
    start = dates[0].replace(month=1, day=1, hour=0, minute=0, second=0, microsecond=0)
    try:
        return np.array([(date - start).total_seconds() for date in dates])
    except TypeError:
        raise entry.error("either all dates have a time zone, or none has") from None


def _date(entry: Entry, index: int, cell: Any) -> datetime.datetime:
    if isinstance(cell, datetime.datetime):
        return cell
    try:
        return datetime.datetime.fromisoformat(str(cell).strip())
    except ValueError:
        raise entry.error(
            f"row {index + 2} of the column with times is {shown(cell)}, expected seconds, or a "
            "date such as 2023-12-31 15:00"
        ) from None


def is_number(cell: Any) -> bool:
    """Whether a cell is a number, or its text."""
    try:
        float(cell)
    except (TypeError, ValueError):
        return False
    return True


def _cell(entry: Entry, index: int, cell: Any) -> float:
    value = float(cell) if is_number(cell) else math.nan
    if not math.isfinite(value):
        raise entry.error(f"row {index + 2} of the column is {shown(cell)}, expected a number")
    return value


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
    return Series.of(point, times, values, _DAY, is_stepped=True)


def _time_of_day(entry: Entry) -> float:
    match = _CLOCK.fullmatch(entry.name)
    hours, minutes, seconds = (int(part or 0) for part in match.groups()) if match else (24, 0, 0)
    if hours > 23 or minutes > 59 or seconds > 59:
        raise entry.error(f"expected a time of day such as '06:00', got {shown(entry.name)}")
    return hours * 3600.0 + minutes * 60.0 + seconds
