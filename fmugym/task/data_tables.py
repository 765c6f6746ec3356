"""Tables of data: columns of cells, which are read as numbers or dates.

A task in a dict may have columns of pandas and arrays of numpy as its data.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.checks import Spellings, check_integer, integer_of, normal_form
from fmugym.errors import ConfigError, first_of, shown, unknown_name
from fmugym.pool.pool import FloatArray
from fmugym.task.dates import Dates, IntArray, shown_date, zone_of

__all__ = ["DataColumn", "DataTable", "is_column", "with_tables"]

Cells = Sequence[Any] | npt.NDArray[Any]
"""The cells of a column: texts of a CSV file, numbers, or timestamps."""

_NAMES_OF_TIME: Final = ("time", "datetime", "timestamp", "date")
_INDEX: Final = ("", "__index_level_0__")
"""Names that pandas writes for an index without a name, in CSV and in Parquet."""

_BLANKS: Final = " \t\r\n"


@dataclass(frozen=True, eq=False)
class DataColumn:
    """A column of a table.

    Attributes:
        table: The name of the file; "" for lists.
        name: Its name.
        cells: Texts, numbers, or moments of numpy.
        rows: The numbers of its rows in the file, shape (n,).
        zone: Zone of moments, which are then those of UTC; None if they have none.
        may_have_commas: Whether a number may have a decimal comma.
        of_year: Whether its numbers are seconds of the year, which an error shows as dates.
    """

    table: str
    name: str
    cells: Cells
    rows: Sequence[int] | IntArray
    zone: str | None = None
    may_have_commas: bool = False
    of_year: bool = False

    def told(self, index: int) -> str:
        """Describe the place of a cell."""
        file = f"{self.table}, " if self.table else ""
        return f"{file}row {self.rows[index]}, column {shown(self.name)}"

    def when(self, index: int) -> str:
        """Say which row that is, and at which time, if this is the column of times."""
        if not self.is_numeric:
            time = shown_date(self.dates.walls[index])
        elif self.of_year:
            seconds = round(float(self.numbers[index]) * 1e6)
            time = shown_date(seconds % (365 * 86400 * 10**6)).removeprefix("1970-")
        else:
            time = _seconds(float(self.numbers[index]))
        return f"row {self.rows[index]} ({time})"

    @property
    def is_numeric(self) -> bool:
        """Whether its first cell that is not empty is a number."""
        if isinstance(self.cells, np.ndarray):
            return self.cells.dtype.kind == "f"
        first = next((one for one in self.cells if not _is_blank(one)), "")
        return _is_number(_pointed(first) if self.may_have_commas else first)

    @cached_property
    def has_commas(self) -> bool:
        """Whether its numbers have decimal commas."""
        return self.may_have_commas and any("," in str(cell) for cell in self.cells)

    @cached_property
    def numbers(self) -> FloatArray:
        """Numbers of the cells, shape (n,); NaN for an empty cell.

        Raises:
            ConfigError: If a cell is no number.
        """
        if isinstance(self.cells, np.ndarray) and self.cells.dtype.kind == "f":
            return self.cells
        numbers = self._read_numbers()
        numbers.setflags(write=False)
        return numbers

    def _read_numbers(self) -> FloatArray:
        cells: Sequence[Any] = self.cells  # type: ignore[assignment]
        if self.has_commas:
            cells = self._with_points()
        with suppress(TypeError, ValueError):
            joined = "".join(cells)
            if _is_plain(joined):
                return np.array([*map(float, cells)])
        return np.array([self._number(i, cell) for i, cell in enumerate(cells)], np.float64)

    def _with_points(self) -> list[str]:
        points = (i for i, cell in enumerate(self.cells) if "." in str(cell))
        if (point := next(points, None)) is not None:
            comma = next(i for i, cell in enumerate(self.cells) if "," in str(cell))
            raise ConfigError(
                f"{self.told(point)}: a column has decimal points or decimal commas, but here is "
                f"{shown(self.cells[point])}, and {shown(self.cells[comma])} in row "
                f"{self.rows[comma]}"
            )
        return [str(cell).replace(",", ".") for cell in self.cells]

    def _number(self, index: int, cell: Any) -> float:
        if _is_blank(cell):
            return np.nan
        if _is_number(cell):
            return float(cell)
        hint = "; leave the cell empty if there is none"
        if isinstance(cell, str) and _is_number(_pointed(cell)):
            hint = "; a decimal comma needs ';' or a tab between cells"
        raise ConfigError(f"{self.told(index)}: expected a number, got {shown(cell)}{hint}")

    @cached_property
    def dates(self) -> Dates:
        """Its dates.

        Raises:
            ConfigError: If a cell is none, or only some have an offset from UTC.
        """
        cells = self.cells
        if not isinstance(cells, np.ndarray) or cells.dtype.kind != "M":
            return Dates.of([*cells], self.told)
        if np.isnat(cells).any():
            raise ConfigError(f"{self.told(int(np.isnat(cells).argmax()))}: the time is missing")
        moments = cells.astype("M8[us]").astype(np.int64)
        if self.zone is None:
            return Dates(moments)
        return Dates.of_instants(moments, zone_of("the time zone of the file", self.zone))

    def dates_in(self, zone: datetime.tzinfo | None) -> Dates:
        """Dates of the cells; a date without an offset from UTC is on the clock of a zone.

        Raises:
            ConfigError: As ``dates``; or if a date does not tell its offset there, or without a
                zone, if an hour of daylight saving time is missing.
        """
        dates = self.dates
        if dates.offsets is None and zone is not None:
            dates = dates.localized(zone, self.told)
        dates.require_no_daylight_saving(self.told)
        return dates


def _seconds(seconds: float) -> str:
    text = f"{seconds:.6f}".rstrip("0").rstrip(".") if abs(seconds) >= 1 else f"{seconds:.10g}"
    return f"{text} s"


def _is_blank(cell: Any) -> bool:
    return cell is None or (isinstance(cell, str) and not cell.strip(_BLANKS))


def _is_plain(text: str) -> bool:
    """Whether Python reads no more than decimal numbers in a text: no Arabic digits, no 1_000."""
    return text.isascii() and "_" not in text


def _pointed(cell: Any) -> Any:
    return cell.replace(",", ".") if isinstance(cell, str) else cell


def _is_number(cell: Any) -> bool:
    try:
        float(cell)
    except (TypeError, ValueError):
        return False
    return not isinstance(cell, str) or _is_plain(cell.strip(_BLANKS))


@dataclass(frozen=True, eq=False)
class DataTable:
    """The columns of a file.

    Attributes:
        columns: In the order of the file.
        separator: Name of the separator of cells; "" for none.
        period: Seconds after which the rows repeat; None for one more row than there are.
        means: By name, for columns of means, the seconds before a row that it is the mean of.
        longest_gap: The longest time without a value, in seconds; None if nothing is known.
        offset: Offset of its times, in seconds east of UTC, if its header tells it.
    """

    columns: Sequence[DataColumn]
    separator: str = ""
    period: float | None = None
    means: Mapping[str, float] = field(default_factory=dict)
    longest_gap: float | None = None
    offset: int | None = None

    @property
    def names(self) -> list[str]:
        """The names of the columns."""
        return [column.name for column in self.columns]

    def find(self, key: str | int) -> DataColumn:
        """Find a column by its name, or by its number from 1 on.

        Raises:
            ConfigError: If there is none, or there may be several of the name.
        """
        if not isinstance(key, str):
            return self.columns[check_integer("column", key, 1, len(self.columns)) - 1]
        own = Spellings("column", self.names).find(key)
        numbers = [i for i, name in enumerate(self.names, 1) if name == own]
        if len(numbers) > 1:
            places = ", ".join(map(str, numbers))
            raise ConfigError(
                f"{len(numbers)} columns are called {shown(key)}: give the number of one ({places})"
            )
        if not numbers:
            raise unknown_name("column", key, self.names)
        return self.columns[numbers[0] - 1]

    def find_time(self) -> DataColumn | None:
        """Find the column of times by its usual names; None if there is none.

        Raises:
            ConfigError: If there are several of a name.
        """
        for word in _NAMES_OF_TIME:
            found = [one for one in self.columns if normal_form(one.name).lower() == word]
            if len(found) > 1:
                names = first_of([shown(column.name) for column in found])
                raise ConfigError(f"name the column with the times as 'time': there are {names}")
            if found:
                return found[0]
        return next((c for c in self.columns if c.name in _INDEX and not c.is_numeric), None)


def is_column(value: Any) -> bool:
    """Whether a value is a column or an index of pandas."""
    return getattr(value, "ndim", None) == 1 and hasattr(type(value), "isna")


def with_tables(data: Any) -> Any:
    """The table ``data`` of a task, in which each entry is a table.

    A column or an array stands for ``values``. A frame of pandas has the column that ``column``
    names, or else the one with the name of the entry, or its only one. An index of pandas gives the
    ``times``, unless there are others or a ``step``, or it only counts the rows.

    Raises:
        ConfigError: If it is not clear which column of a frame is meant.
    """
    if not isinstance(data, Mapping):
        return data
    return {name: _table(name, one) for name, one in data.items()}


def _table(name: Any, given: Any) -> Any:
    if _is_frame(given) or is_column(given) or (isinstance(given, np.ndarray) and given.ndim == 1):
        given = {"values": given}
    if not isinstance(given, Mapping):
        return given
    table = dict(given)
    if _is_frame(table.get("values")):
        table["values"] = _chosen(name, table["values"], table.pop("column", None))
    index = getattr(table.get("values"), "index", None)
    is_count = getattr(index, "start", None) == 0 and getattr(index, "step", None) == 1
    if is_column(index) and not is_count and not table.keys() & {"times", "step"}:
        table["times"] = index
    return table


def _is_frame(value: Any) -> bool:
    return getattr(value, "ndim", None) == 2 and hasattr(type(value), "isna")


def _chosen(name: Any, frame: Any, column: Any) -> Any:
    """The column of a frame that is meant."""
    columns = [*frame.columns]
    if column is None and len(columns) > 1 and name not in columns:
        raise ConfigError(
            f"data.{name}: the frame has the columns {', '.join(map(repr, columns))}; "
            "name one by 'column'"
        )
    place = integer_of(column)
    if column is None:
        place = 1 + (columns.index(name) if name in columns else 0)
    elif place is None:
        if column not in columns:
            raise ConfigError(f"data.{name}: {unknown_name('column', column, columns)}")
        place = 1 + columns.index(column)
    if not 1 <= place <= len(columns):
        raise ConfigError(
            f"data.{name}: column = {place}, but the frame has {len(columns)}, from 1 on"
        )
    return frame.iloc[:, place - 1]
