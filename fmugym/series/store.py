"""Stores for the rows of a recorder: memory, a CSV file, a Parquet file."""

from __future__ import annotations

import csv
import json
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, Protocol

from fmugym.errors import ConfigError, shown
from fmugym.extras import imported
from fmugym.task.quantity import Quantity

__all__ = [
    "FAULT",
    "WHOLE",
    "MemoryStore",
    "RowStore",
    "heading",
    "open_store",
]

FAULT: Final = "fault"
"""The last column: the reason of a fault, a text."""

WHOLE: Final = ("index", "flag")
"""The kinds of columns that hold whole numbers."""

_ROWS_OF_A_GROUP: Final = 20_000
"""Rows that a Parquet file gets at once."""


class RowStore(Protocol):
    """Takes rows, in the form of a ``TimeSeries``."""

    def add(self, rows: Any) -> None:
        """Add rows."""

    def close(self) -> None:
        """Add no more rows; more than one call is fine."""


def open_store(path: Path, columns: Sequence[Quantity]) -> RowStore:
    """Make a store that writes a new file, of the format that its name tells.

    Raises:
        ConfigError: If the name ends with something else, or a library is missing.
        FileExistsError: If the file exists.
    """
    kinds: dict[str, type[CsvStore | ParquetStore]] = {".csv": CsvStore, ".parquet": ParquetStore}
    kind = kinds.get(path.suffix.lower())
    if kind is None:
        raise ConfigError(f"a recording is a .csv or .parquet file, got {shown(str(path))}")
    return kind(path, columns)


class MemoryStore:
    """Keeps the latest rows in memory.

    Args:
        start: The first rows, or none.
        most_rows: The rows to keep; earlier ones are dropped.
    """

    def __init__(self, start: Any, most_rows: int) -> None:
        self._start, self._most, self._rows = start, most_rows, 0
        self._blocks: deque[Any] = deque()
        self._small: list[Any] = []

    def add(self, rows: Any) -> None:
        """Add rows. Small blocks are put together, since each takes memory of its own."""
        self._small.append(rows)
        self._rows += len(rows)
        if len(self._small) >= 1000:
            self._blocks.append(self._start.joined(self._small))
            self._small = []
        while self._blocks and self._rows - len(self._blocks[0]) >= self._most:
            self._rows -= len(self._blocks.popleft())

    def close(self) -> None:
        """Do nothing: rows stay."""

    def rows(self) -> Any:
        """All rows that are kept."""
        return self._start.joined([*self._blocks, *self._small])


def heading(column: Quantity) -> str:
    """The name and the unit of a column, such as ``T [degC]``."""
    return f"{column.name} [{column.unit}]" if column.unit else column.name


class CsvStore:
    """Writes a CSV file; each row is in the file at once, so that an interruption loses none."""

    def __init__(self, path: Path, columns: Sequence[Quantity]) -> None:
        self._path = path
        self._file = path.open("x", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._writer.writerow([*map(heading, columns), FAULT])

    def add(self, rows: Any) -> None:
        """See ``RowStore``."""
        columns = [cells.tolist() for cells in rows.cells()]
        for number, row in enumerate(zip(*columns, strict=True)):
            cells = ["" if cell != cell else cell for cell in row]  # no NaN
            self._writer.writerow([*cells, rows.faults.get(number, "")])
        try:
            self._file.flush()
        except OSError as error:  # a full disk: what is in the file stays
            with suppress(OSError):
                self._file.close()
            error.filename = str(self._path)
            raise

    def close(self) -> None:
        """See ``RowStore``."""
        self._file.close()


class ParquetStore:
    """Writes a Parquet file. Rows are written in groups, the last one by ``close``."""

    def __init__(self, path: Path, columns: Sequence[Quantity]) -> None:
        self._arrow = imported("pyarrow", "parquet")
        parquet = imported("pyarrow.parquet", "parquet")
        self._file = path.open("xb")
        self._schema = self._arrow.schema([*map(self._field, columns), (FAULT, "string")])
        self._writer = parquet.ParquetWriter(self._file, self._schema)
        self._waiting: list[Any] = []
        self._rows = 0

    def _field(self, column: Quantity) -> Any:
        facts = {"unit": column.unit, "quantity": json.dumps(asdict(column))}
        kind = "int64" if column.kind in WHOLE else "float64"
        return self._arrow.field(column.name, self._arrow.type_for_alias(kind), metadata=facts)

    def add(self, rows: Any) -> None:
        """See ``RowStore``."""
        self._waiting.append(rows)
        self._rows += len(rows)
        if self._rows >= _ROWS_OF_A_GROUP:
            self._write()

    def _write(self) -> None:
        first, *others = self._waiting
        rows, self._waiting, self._rows = first.joined(others), [], 0
        arrays = [self._arrow.array(values, from_pandas=False) for values in rows.cells()]
        faults = [rows.faults.get(number) for number in range(len(rows))]
        table = [*arrays, self._arrow.array(faults, self._arrow.string())]
        self._writer.write_table(self._arrow.table(table, schema=self._schema))

    def close(self) -> None:
        """See ``RowStore``."""
        if not self._file.closed:
            if self._waiting:
                self._write()
            self._writer.close()
            self._file.close()
