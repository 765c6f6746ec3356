"""Time series of episodes: a table whose columns have names, units and meanings.

A recorder's rows are stored in memory, a CSV file or a Parquet file.
"""

from __future__ import annotations

import csv
import json
import os
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from fmugym.checks import Spellings, check_path
from fmugym.environment.episode import Quantity
from fmugym.errors import ConfigError, shown
from fmugym.extras import imported
from fmugym.pool.pool import FloatArray

__all__ = ["FAULT", "WHOLE", "MemoryStore", "RowStore", "TimeSeries", "heading", "open_store"]

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


@dataclass(frozen=True)
class TimeSeries:
    """Table that a recorder has written, one row for each moment.

    Attributes:
        columns: What the columns are. Beside the kinds of ``fmugym.environment.episode``, there are
            ``"index"`` (environment, episode, step), ``"time"``, ``"observation"``, ``"reward"``,
            ``"reward term"``, ``"cost"``, ``"cost term"``, ``"kpi"`` (of the episode until now) and
            ``"flag"`` (terminated, truncated).
        values: Shape (rows, columns).
        faults: The reasons of faults by row.
        cost_limits: Limits of the costs of an episode, by name.
    """

    columns: tuple[Quantity, ...]
    values: FloatArray = field(repr=False)
    faults: Mapping[int, str] = field(default_factory=dict)
    cost_limits: Mapping[str, float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """The values of a column, shape (rows,)."""
        names = [column.name for column in self.columns]
        return self.values[:, names.index(Spellings("column", names).require(name))]

    def cells(self) -> list[npt.NDArray[Any]]:
        """Columns as arrays: int64 for indices and flags, float64 for all others."""
        return [
            values.astype(np.int64) if column.kind in WHOLE else values
            for column, values in zip(self.columns, self.values.T, strict=True)
        ]

    def of_kind(self, *kinds: str) -> list[Quantity]:
        """The columns of some kinds."""
        return [column for column in self.columns if column.kind in kinds]

    @property
    def units(self) -> dict[str, str]:
        """Known units by name."""
        return {column.name: column.unit for column in self.columns if column.unit}

    def episodes(self) -> dict[tuple[int, int], TimeSeries]:
        """The rows of each episode, by the numbers of environment and episode."""
        names = [column.name for column in self.columns]
        episode = self["episode"].astype(np.int64)
        env = self["environment"] if "environment" in names else np.zeros(len(self))
        keys = np.stack([env.astype(np.int64), episode], axis=1)
        unique = dict.fromkeys(map(tuple, keys.tolist()))
        return {key: self._where((keys == key).all(axis=1)) for key in unique}

    def _where(self, mask: Any) -> TimeSeries:
        rows = np.flatnonzero(mask).tolist()
        faults = {new: self.faults[old] for new, old in enumerate(rows) if old in self.faults}
        return replace(self, values=self.values[rows], faults=faults)

    def joined(self, others: Iterable[TimeSeries]) -> TimeSeries:
        """Put the rows of others, which have the same columns, behind these."""
        parts, begin = [self, *others], 0
        faults: dict[int, str] = {}
        for part in parts:
            faults |= {begin + row: reason for row, reason in part.faults.items()}
            begin += len(part)
        values = np.concatenate([part.values for part in parts])
        return replace(self, values=values, faults=faults)

    # Files.

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a new file: CSV, with names and units in the first line, or Parquet.

        Args:
            path: Ends with ``.csv``, or with ``.parquet``, which needs the extra ``parquet``.

        Raises:
            ConfigError: If it ends with something else, or pyarrow is missing.
            FileExistsError: If the file exists.
        """
        store = open_store(check_path("the path of a recording", path), self.columns)
        store.add(self)
        store.close()

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> TimeSeries:
        """Read a Parquet file that a recorder has written.

        Raises:
            ConfigError: If it is none, or pyarrow is missing.
        """
        file = check_path("the path of a recording", path)
        parquet: Any = imported("pyarrow.parquet", "parquet")
        try:
            table = parquet.read_table(file)
            fields = [one for one in table.schema if one.name != FAULT]
            columns = [Quantity(**json.loads(one.metadata[b"quantity"])) for one in fields]
        except FileNotFoundError:
            raise
        except Exception as error:  # a damaged file may raise anything
            raise ConfigError(f"{shown(str(file))} is no recording: {error}") from None
        stored = [table.column(column.name).to_numpy() for column in columns]
        faults = enumerate(table.column(FAULT).to_pylist())
        told = {row: why for row, why in faults if why is not None}
        return cls(tuple(columns), np.stack(stored, axis=1).astype(np.float64), told)

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame; ``frame.attrs["units"]`` has the units by name.

        Raises:
            ConfigError: If pandas is missing.
        """
        names = [column.name for column in self.columns]
        cells = dict(zip(names, self.cells(), strict=True))
        frame: Any = imported("pandas", "pandas").DataFrame(cells)
        frame[FAULT] = [self.faults.get(row, "") for row in range(len(self))]
        frame.attrs["units"] = self.units
        return frame
