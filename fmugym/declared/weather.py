"""Weather of EnergyPlus (EPW files), and the tables of Modelica, which may be such weather.

Sources: EnergyPlus, Auxiliary Programs, "EnergyPlus Weather File (EPW) Data Dictionary", for the
fields, their order, their codes for missing values, and what is a mean of the time before;
Modelica Standard Library, ``Modelica.Blocks.Sources.CombiTimeTable``, for tables, jumps and
repetition; Modelica Buildings, ``BoundaryConditions.WeatherData.ReaderTMY3``, for tables of
weather.
"""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError, reading, shown

__all__ = ["Cells", "FloatArray", "Table", "read_modelica", "read_weather"]

FloatArray = npt.NDArray[np.float64]

Cells = Sequence[Any] | FloatArray
"""The cells of a column: texts of a CSV file, values of a Parquet file, numbers."""

_HOUR: Final = 3600.0
_DAY: Final = 86400.0
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
"""How the names of fields end that are means of the time since the row before."""

_WIDTH: Final = len(_DATES) + len(_CODES)
_PERIODS: Final = re.compile(r"^DATA PERIODS\s*,\s*\d+\s*,\s*([1-9]\d?)\s*(?:,.*)?$", re.M)
_TABLE: Final = re.compile(
    r"^\s*(?:double|float)\s+([^\s(]+)\s*\(\s*([1-9]\d{0,8})\s*,\s*([1-9]\d{0,8})\s*\).*$", re.M
)


class Table(NamedTuple):
    """The columns of a file.

    Attributes:
        columns: The cells of each column by name, in the order of the file. NaN is a number that
            is missing.
        period: Seconds after which the rows repeat; None for one more row than there are.
        means: By name, for columns of means, the seconds before a row that it is the mean of.
    """

    columns: Mapping[str, Cells]
    period: float | None = None
    means: Mapping[str, float] = {}


def read_weather(name: str, lines: Sequence[str]) -> Table:
    """Read weather of EnergyPlus.

    Times are those of the file: local standard time, from the beginning of a year of 365 days. The
    years of the rows do not count, because those of typical months differ.

    Args:
        name: What the file is called.
        lines: Its lines.

    Raises:
        ConfigError: If they are no such weather.
    """
    with reading(f"{name} is no weather of EnergyPlus"):
        per_hour, numbers = _records("\n".join(lines))
        times = [_end_of(row, i % per_hour + 1, per_hour) for i, row in enumerate(numbers)]
        return _weather((*_DATES, *_CODES), numbers, np.array(times), _CODES)


def _records(text: str) -> tuple[int, FloatArray]:
    """How many there are in an hour, and their numbers, without those of a leap day."""
    head = _PERIODS.search(text)
    lines = text[head.end() :].splitlines() if head else []
    rows = [line.split(",")[:_WIDTH] for line in lines if line.strip()]
    widths = {len(row) for row in rows}
    if head is None or len(widths) != 1:
        raise ValueError(
            f"expected rows of {_WIDTH} cells below a line such as 'DATA PERIODS,1,1,Data,Sunday,"
            "1/1,12/31'"
        )
    cells = [[cell.strip() or "nan" for cell in (*row[:5], "", *row[6:])] for row in rows]
    numbers = np.array(cells, np.float64)
    return int(head[1]), numbers[(numbers[:, 1:3] != (2, 29)).any(axis=1)]


def _end_of(row: FloatArray, part: int, parts: int) -> float:
    """When a record ends. Hour 1 is the first of a day; minutes mean several things in practice."""
    month, day, hour = map(int, row[1:4])
    if not 1 <= hour <= 24:
        raise ValueError(f"expected hours from 1 to 24, got {hour}")
    days = datetime.date(_ANY_YEAR, month, day).timetuple().tm_yday - 1
    return days * _DAY + (hour - 1 + part / parts) * _HOUR


def _weather(
    names: Sequence[str], rows: FloatArray, times: FloatArray, codes: Mapping[str, float]
) -> Table:
    """Weather of rows of fields. It lasts whole days, with a row for its first midnight or not."""
    found = zip(names, rows.T, strict=False)  # the last fields may be missing
    columns = {
        name: np.where(values < codes.get(name, math.inf), values, np.nan) for name, values in found
    }
    period = math.ceil((times[-1] - times[0]) / _DAY) * _DAY
    step = float(np.diff(times[:2]).sum())
    means = {name: step for name in columns if name.endswith(_MEANS)}
    return Table({**columns, "time": times}, period, means)


def read_modelica(name: str, lines: Sequence[str]) -> dict[str, Table]:
    """Read the tables of a text file of Modelica, by name.

    Columns are called ``"time"``, ``"2"``, ``"3"`` and so on, or like the fields of weather, if
    comments say that it is. Two rows of one time are a jump. A table repeats like a periodic
    ``CombiTimeTable``: its last row is at the time of the first one of the next period.

    Args:
        name: What the file is called.
        lines: Its lines; the first one is ``#1``.

    Raises:
        ConfigError: If there is no table, or its numbers are not as many as it says.
    """
    is_weather = any(line.startswith("#LOCATION,") for line in lines)
    _, *parts = _TABLE.split("\n".join(line.partition("#")[0] for line in lines))
    if not parts:
        raise ConfigError(f"{name} has no table, such as 'double tab1(8760,2)'")
    return {
        key: _modelica_table(f"the table {shown(key)} of {name}", (rows, width), cells, is_weather)
        for key, rows, width, cells in zip(*(parts[i::4] for i in range(4)), strict=True)
    }


def _modelica_table(what: str, shape: tuple[str, str], cells: str, is_weather: bool) -> Table:
    with reading(f"{what} is damaged"):
        numbers = np.array(cells.translate(str.maketrans(",;", "  ")).split(), np.float64)
        numbers = numbers.reshape(*map(int, shape))
    times, width = numbers[:, 0], len(numbers.T)
    period = float(times[-1] - times[0])
    is_left = np.append(np.diff(times) == 0, True)  # the first row comes again after the last one
    times = times - _BEFORE_JUMP * period * is_left
    if is_weather and width == 1 + len(_CODES):
        return _weather(("time", *_CODES), numbers, times, _CODES_OF_TABLES)
    columns = dict(zip(("time", *map(str, range(2, width + 1))), numbers.T, strict=True))
    return Table(columns | {"time": times}, period or _DAY)
