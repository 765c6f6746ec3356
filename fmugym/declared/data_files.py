"""Files of data: CSV and Parquet, weather of EnergyPlus, and tables of Modelica."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from fmugym.checks import require_regular
from fmugym.declared.data_tables import DataColumn, DataTable
from fmugym.declared.weather import read_modelica, read_weather
from fmugym.errors import ConfigError, reading_file, reason, shown
from fmugym.extras import imported

__all__ = ["read_tables"]

_PARQUET: Final = (".parquet", ".pq")
_SEPARATORS: Final = {";": "semicolons", "\t": "tabs", ",": "commas"}
_QUOTED: Final = re.compile('"[^"]*"')


def read_tables(path: Path) -> Mapping[str, DataTable]:
    """Read the tables of a file by name. A file that has not changed is read once.

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
