"""Files of data: CSV and Parquet, weather of EnergyPlus (EPW files), and tables of Modelica.

Tables of Modelica may contain such weather. Sources: EnergyPlus, Auxiliary Programs, "EnergyPlus
Weather File (EPW) Data Dictionary", for the fields, their order, their codes for missing values,
and what is a mean of the time before; Modelica Standard Library,
``Modelica.Blocks.Sources.CombiTimeTable``, for tables, jumps and repetition; Modelica Buildings,
``BoundaryConditions.WeatherData.ReaderTMY3``, for tables of weather.
"""

from __future__ import annotations

import codecs
import csv
import datetime
import io
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from fmugym.checks import require_regular
from fmugym.errors import ConfigError, reading_file, reason, shown
from fmugym.extras import imported
from fmugym.pool.pool import FloatArray
from fmugym.task.data_tables import DataColumn, DataTable
from fmugym.task.dates import DAY, HOUR, YEAR

__all__ = ["read_modelica", "read_tables", "read_weather"]

_ANY_YEAR: Final = 2001  # a year of the clock has no leap day

_BEFORE_JUMP: Final = 1e-9
"""The part of a table's time by which the value before a jump comes earlier."""

_DATES: Final = ("Year", "Month", "Day", "Hour", "Minute", "Data Source and Uncertainty Flags")

_CODES: Final[Mapping[str, float]] = {
    "Dry Bulb Temperature": 99.9,
    "Dew Point Temperature": 99.9,
    "Relative Humidity": 999,
    "Atmospheric Station Pressure": 999999,
    "Extraterrestrial Horizontal Radiation": 9999,
    "Extraterrestrial Direct Normal Radiation": 9999,
    "Horizontal Infrared Radiation Intensity": 9999,
    "Global Horizontal Radiation": 9999,
    "Direct Normal Radiation": 9999,
    "Diffuse Horizontal Radiation": 9999,
    "Global Horizontal Illuminance": 999900,
    "Direct Normal Illuminance": 999900,
    "Diffuse Horizontal Illuminance": 999900,
    "Zenith Luminance": 9999,
    "Wind Direction": 999,
    "Wind Speed": 999,
    "Total Sky Cover": 99,
    "Opaque Sky Cover": 99,
    "Visibility": 9999,
    "Ceiling Height": 99999,
    "Present Weather Observation": math.inf,
    "Present Weather Codes": math.inf,
    "Precipitable Water": 999,
    "Aerosol Optical Depth": 0.999,
    "Snow Depth": 999,
    "Days Since Last Snowfall": 99,
    "Albedo": 999,
    "Liquid Precipitation Depth": 999,
    "Liquid Precipitation Quantity": 99,
}
"""The fields of weather, and the number from which on a value is missing."""

_CODES_OF_TABLES: Final = {**_CODES, "Wind Direction": math.inf}
"""The same in tables, which count turns of the wind beyond 360 degrees."""

_MEANS: Final = ("Radiation", "Illuminance", "Luminance")
"""Ends of the names of fields whose values are means since the row before."""

_PLACE_OF_OFFSET: Final = 8
"""The cell of the line of the place with the hours from UTC."""

_MOST_HOURS: Final = 24

_WIDTH: Final = len(_DATES) + len(_CODES)
_PERIODS: Final = re.compile(r"^DATA PERIODS\s*,\s*\d+\s*,\s*([1-9]\d?)\s*(?:,.*)?$", re.M)
_TABLE: Final = re.compile(
    r"^\s*(?:double|float)\s+([^\s(]+)\s*\(\s*([1-9]\d{0,8})\s*,\s*([1-9]\d{0,8})\s*\).*$", re.M
)


def read_weather(name: str, lines: Sequence[str]) -> DataTable:
    """Read weather of EnergyPlus.

    Times are those of the file: local standard time, from the beginning of a year of 365 days. The
    years of the rows do not count, because those of typical months differ; after December comes
    January of the next year.

    Args:
        name: Name of the file.
        lines: Its lines.

    Raises:
        ConfigError: If they are no such weather.
    """
    with reading_file(f"{name} is no weather of EnergyPlus"):
        per_hour, fields = _fields(name, "\n".join(lines))
        dates = zip(*(fields[key].numbers.tolist() for key in _DATES[1:4]), strict=True)
        times = np.array(
            [_end_of(date, i % per_hour + 1, per_hour) for i, date in enumerate(dates)]
        )
        times += YEAR * np.cumsum(np.diff(times, prepend=times[0]) < -YEAR / 2)
        return _weather([*fields.values()], times, _CODES, lines)


def _fields(name: str, text: str) -> tuple[int, dict[str, DataColumn]]:
    """Number of records in an hour, and fields of all records but those of 29 February."""
    head = _PERIODS.search(text)
    above = text.count("\n", 0, head.end()) + 1 if head else 0
    lines = enumerate(text.split("\n")[above:] if head else [], above + 1)
    records = {number: line.split(",")[:_WIDTH] for number, line in lines if line.strip()}
    if head is None or len({*map(len, records.values())}) != 1:
        raise ValueError(
            f"expected rows of {_WIDTH} cells below a line such as 'DATA PERIODS,1,1,Data,Sunday,"
            "1/1,12/31'"
        )
    kept = {n: one for n, one in records.items() if not _is_leap_day(one)}
    columns = zip((*_DATES, *_CODES), zip(*kept.values(), strict=True), strict=False)
    fields = {key: DataColumn(name, key, cells, [*kept]) for key, cells in columns}
    flags = _DATES[-1]
    return int(head[1]), fields | {flags: replace(fields[flags], cells=np.full(len(kept), np.nan))}


def _is_leap_day(record: Sequence[str]) -> bool:
    return [cell.strip().lstrip("0") for cell in record[1:3]] == ["2", "29"]


def _offset(lines: Sequence[str]) -> int | None:
    """The offset from UTC that the line of the place tells, in seconds; None if it tells none."""
    line = next((one for one in lines if one.lstrip("#").startswith("LOCATION,")), "")
    cells = line.split(",")
    with suppress(IndexError, ValueError):
        hours = float(cells[_PLACE_OF_OFFSET])
        return round(hours * HOUR) if abs(hours) < _MOST_HOURS else None
    return None


def _end_of(date: Sequence[float], part: int, parts: int) -> float:
    """End of a record. Hour 1 is the first of a day; minutes mean several things in practice."""
    month, day, hour = map(int, date)
    if not 1 <= hour <= 24:
        raise ValueError(f"expected hours from 1 to 24, got {hour}")
    days = datetime.date(_ANY_YEAR, month, day).timetuple().tm_yday - 1
    return days * DAY + (hour - 1 + part / parts) * HOUR


def _weather(
    fields: Sequence[DataColumn],
    times: FloatArray,
    codes: Mapping[str, float],
    lines: Sequence[str],
) -> DataTable:
    """Weather of fields. It lasts whole days, with a row for its first midnight or not."""
    fields = [one for one in fields if one.name != "time"]
    columns = [_without(one, codes.get(one.name, math.inf)) for one in fields]
    time = replace(fields[0], name="time", cells=times, of_year=True)
    return DataTable(
        [*columns, time] if _DATES[0] in fields[0].name else [time, *columns],
        period=math.ceil((times[-1] - times[0]) / DAY) * DAY,
        means={one.name: float(np.diff(times[:2]).sum()) for one in columns if _is_mean(one)},
        longest_gap=DAY,
        offset=_offset(lines),
    )


def _without(field: DataColumn, code: float) -> DataColumn:
    """A field without the values that say that one is missing."""
    return replace(field, cells=np.where(field.numbers < code, field.numbers, np.nan))


def _is_mean(field: DataColumn) -> bool:
    return field.name.endswith(_MEANS)


def read_modelica(name: str, lines: Sequence[str]) -> dict[str, DataTable]:
    """Read the tables of a text file of Modelica, by name.

    Columns are called ``"time"``, ``"2"``, ``"3"`` and so on, or like the fields of weather, if
    comments say that it is. Two rows of one time are a jump. A table repeats like a periodic
    ``CombiTimeTable``: its last row is at the time of the first one of the next period.

    Args:
        name: Name of the file.
        lines: Its lines; the first one is ``#1``.

    Raises:
        ConfigError: If there is no table, or its numbers are not as many as it says.
    """
    _, *parts = _TABLE.split("\n".join(line.partition("#")[0] for line in lines))
    if not parts:
        raise ConfigError(f"{name} has no table, such as 'double tab1(8760,2)'")
    head = [line for line in lines if line.startswith("#LOCATION,")]
    return {
        key: _modelica_table(
            f"the table {shown(key)} of {name}", int(rows), int(width), cells, head
        )
        for key, rows, width, cells in zip(*(parts[i::4] for i in range(4)), strict=True)
    }


def _modelica_table(what: str, rows: int, width: int, text: str, head: Sequence[str]) -> DataTable:
    cells = text.translate(str.maketrans(",;", "  ")).split()
    if len(cells) != rows * width:
        raise ConfigError(f"{what} has {len(cells)} numbers, expected a shape of ({rows}, {width})")
    is_weather = bool(head) and width == 1 + len(_CODES)
    names = ("time", *_CODES) if is_weather else ("time", *map(str, range(2, width + 1)))
    numbers = range(1, rows + 1)
    columns = [DataColumn(what, name, cells[i::width], numbers) for i, name in enumerate(names)]
    times, *_ = [column.numbers for column in columns]
    period = float(times[-1] - times[0])
    is_left = np.append(np.diff(times) == 0, True)  # the first row comes again after the last one
    times = times - _BEFORE_JUMP * period * is_left
    if is_weather:
        return _weather(columns, times, _CODES_OF_TABLES, head)
    columns[0] = replace(columns[0], cells=times)
    return DataTable(columns, period=period or DAY, offset=_offset(head))


_PARQUET: Final = (".parquet", ".pq")
_SEPARATORS: Final = {";": "semicolons", "\t": "tabs", ",": "commas"}
_QUOTED: Final = re.compile('"[^"]*"')


def read_tables(path: Path) -> Mapping[str, DataTable]:
    """Read a CSV, Parquet, EPW or Modelica file as tables by name; only Modelica's has several.

    A file that has not changed is read once.

    Raises:
        ConfigError: If it is no table, or pyarrow is missing.
        OSError: If it cannot be read.
    """
    require_regular(path)
    status = path.stat()
    read = _read_parquet if path.suffix.lower() in _PARQUET else _read_text
    return read(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=16)
def _read_parquet(path: Path, changed: int, size: int) -> Mapping[str, DataTable]:
    """Read a Parquet file, whose cells have types."""
    pyarrow, parquet = imported("pyarrow", "parquet"), imported("pyarrow.parquet", "parquet")
    try:
        table = parquet.ParquetFile(path).read()
        columns = [
            _column_of_arrow(path.name, name, column)
            for name, column in zip(table.column_names, table.columns, strict=True)
        ]
    except (pyarrow.ArrowException, ValueError) as error:
        raise ConfigError(f"{path.name} is no Parquet file: {reason(error)}") from None
    if not table.num_rows:
        raise ConfigError(f"{path.name} has no rows")
    return {path.stem: DataTable(columns)}


def _column_of_arrow(file: str, name: str, column: Any) -> DataColumn:
    pyarrow: Any = imported("pyarrow", "parquet")
    types, kind, rows = pyarrow.types, column.type, range(2, len(column) + 2)
    if types.is_timestamp(kind) or types.is_date(kind):
        return DataColumn(file, name, column.to_numpy(), rows, getattr(kind, "tz", None))
    tests = types.is_integer, types.is_floating, types.is_decimal, types.is_boolean
    if any(test(kind) for test in tests):
        numbers = column.cast(pyarrow.float64(), safe=False).to_numpy()
        return DataColumn(file, name, numbers, rows)
    return DataColumn(file, name, column.to_pylist(), rows)


@lru_cache(maxsize=16)
def _read_text(path: Path, changed: int, size: int) -> Mapping[str, DataTable]:
    """Read a file of text, whose first line tells its format."""
    content = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    if content.startswith((b"#1", b"LOCATION,")):  # names of places have any encoding
        lines = [line.decode("latin-1") for line in content.splitlines()]
        if content.startswith(b"#1"):
            return read_modelica(path.name, lines)
        return {path.stem: read_weather(path.name, lines)}
    return {path.stem: _read_csv(path, content)}


def _read_csv(path: Path, content: bytes) -> DataTable:
    """Read a CSV file.

    Raises:
        ConfigError: If it has no rows, they are not of one length, a cell has more than 128 KiB,
            or it is no text in UTF-8.
    """
    try:
        file = io.StringIO(content.decode("utf-8-sig"), newline="")
    except UnicodeDecodeError:
        raise ConfigError(f"{shown(str(path))} is not encoded in UTF-8") from None
    heading = _QUOTED.sub("", file.readline())
    separator = next((one for one in _SEPARATORS if one in heading), ",")
    file.seek(0)
    with reading_file(f"{path.name} is no table"):
        numbers, lines = _lines([*csv.reader(file, delimiter=separator)])
    header, rows = (lines or [[]])[0], lines[1:]
    if wrong := {*map(len, rows)} - {len(header)}:
        place = next(i for i, row in enumerate(rows, 1) if len(row) in wrong)
        raise ConfigError(
            f"row {numbers[place]} of {path.name} has {len(lines[place])} cells, expected "
            f"{len(header)}"
        )
    if not rows:
        raise ConfigError(f"{path.name} has no rows below its header")
    has_commas = separator != ","
    columns = [
        DataColumn(path.name, name.strip(), cells, numbers[1:], may_have_commas=has_commas)
        for name, cells in zip(header, zip(*rows, strict=True), strict=True)
    ]
    return DataTable(columns, _SEPARATORS[separator])


def _lines(lines: list[list[str]]) -> tuple[Sequence[int], list[list[str]]]:
    """The lines that are not blank, with their numbers; of a single column, these are cells."""
    numbers = range(1, len(lines) + 1)
    if all(lines):
        return numbers, lines
    kept = [(number, line) for number, line in zip(numbers, lines, strict=True) if line]
    if kept and len(kept[0][1]) == 1:
        (first, _), (last, _) = kept[0], kept[-1]
        kept = [(number, lines[number - 1] or [""]) for number in range(first, last + 1)]
    return [number for number, _ in kept], [line for _, line in kept]
