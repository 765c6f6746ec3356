"""Where the rows of a recorder go: memory, a CSV file, a Parquet file."""

from __future__ import annotations

import csv
import json
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError, shown
from fmugym.extras import imported
from fmugym.pool.base import FloatArray
from fmugym.signals import Ignoring, ordinary
from fmugym.task.quantity import TEXT_KINDS, Quantity

__all__ = [
    "FAULT",
    "TEXT",
    "WHOLE",
    "Block",
    "Memory",
    "Store",
    "cells_of",
    "heading",
    "open_store",
]

FAULT: Final = "fault"
"""The last column: the reason of a fault, a text."""

TEXT: Final = "text"
"""What stands in the place of the unit where cells are texts."""

WHOLE: Final = ("index", "flag")
"""The kinds of columns that hold whole numbers."""

_ROWS_OF_A_GROUP: Final = 20_000
"""Rows that a Parquet file gets at once."""


@dataclass(frozen=True)
class Block:
    """Some rows.

    Attributes:
        values: Shape (rows, columns).
        faults: The reasons of faults by row.
        texts: The texts that numbers in columns of texts stand for.
    """

    values: FloatArray
    faults: Mapping[int, str]
    texts: Mapping[float, str]

    def __len__(self) -> int:
        return len(self.values)

    def cells(self, columns: Iterable[Quantity]) -> Iterator[npt.NDArray[Any]]:
        """The values of each column, see ``cells_of``."""
        pairs = zip(self.values.T, columns, strict=True)
        return (cells_of(values, column, self.texts) for values, column in pairs)

    @classmethod
    def joined(cls, blocks: Iterable[Block], width: int) -> Block:
        """Put blocks together."""
        blocks, begin = list(blocks), 0
        faults: dict[int, str] = {}
        texts: dict[float, str] = {}
        for block in blocks:
            texts |= block.texts
            faults |= {begin + row: reason for row, reason in block.faults.items()}
            begin += len(block)
        values = [block.values for block in blocks]
        return cls(np.concatenate(values) if values else np.empty((0, width)), faults, texts)


class Store(Protocol):
    """Takes rows."""

    def add(self, block: Block) -> None:
        """Add rows."""

    def close(self) -> None:
        """Add no more rows; more than one call is fine."""


def open_store(path: Path, columns: Sequence[Quantity]) -> Store:
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


class Memory:
    """Keeps the latest rows in memory.

    Args:
        columns: The columns.
        most_rows: The rows to keep; earlier ones are dropped.
    """

    def __init__(self, columns: Sequence[Quantity], most_rows: int) -> None:
        self._width, self._most = len(columns), most_rows
        self._blocks: deque[Block] = deque()
        self._small: list[Block] = []
        self._rows = 0

    def add(self, block: Block) -> None:
        """Add rows. Small blocks are put together, since each takes memory of its own."""
        self._small.append(block)
        self._rows += len(block)
        if len(self._small) >= 1000:
            self._join()
        while self._blocks and self._rows - len(self._blocks[0]) >= self._most:
            self._rows -= len(self._blocks.popleft())

    def _join(self) -> None:
        self._blocks.append(Block.joined(self._small, self._width))
        self._small = []

    def close(self) -> None:
        """Do nothing: rows stay."""

    def rows(self) -> Block:
        """All rows that are kept."""
        return Block.joined([*self._blocks, *self._small], self._width)


def heading(column: Quantity) -> str:
    """The name and the unit of a column, such as ``T [degC]``; that of texts is ``[text]``."""
    if column.kind in TEXT_KINDS:
        return f"{column.name} [{TEXT}]"
    return f"{column.name} [{column.unit}]" if column.unit else column.name


def cells_of(values: FloatArray, column: Quantity, texts: Mapping[float, str]) -> npt.NDArray[Any]:
    """The values of a column in their own type; a text that is missing is None."""
    if column.kind in TEXT_KINDS:
        return np.array([texts.get(value) for value in values.tolist()], object)
    return values.astype(np.int64) if column.kind in WHOLE else values


class CsvStore:
    """Writes a CSV file; each row is in the file at once, so that an interruption loses none."""

    def __init__(self, path: Path, columns: Sequence[Quantity]) -> None:
        self._path = path
        self._file = path.open("x", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._columns = columns
        self._writer.writerow([*map(heading, columns), FAULT])

    def add(self, block: Block) -> None:
        """See ``Store``."""
        columns = [cells.tolist() for cells in block.cells(self._columns)]
        for number, row in enumerate(zip(*columns, strict=True)):
            cells = ["" if cell != cell else cell for cell in row]  # no NaN
            self._writer.writerow([*cells, block.faults.get(number, "")])
        try:
            self._file.flush()
        except ordinary(OSError) as error:  # a full disk: what is in the file stays
            with Ignoring(OSError):
                self._file.close()
            error.filename = str(self._path)
            raise

    def close(self) -> None:
        """See ``Store``."""
        self._file.close()


class ParquetStore:
    """Writes a Parquet file. Rows are written in groups, the last one by ``close``."""

    def __init__(self, path: Path, columns: Sequence[Quantity]) -> None:
        self._arrow = imported("pyarrow", "parquet")
        parquet = imported("pyarrow.parquet", "parquet")
        self._file = path.open("xb")
        self._columns, self._rows = columns, 0
        self._schema = self._arrow.schema([*map(self._field, columns), (FAULT, "string")])
        self._writer = parquet.ParquetWriter(self._file, self._schema)
        self._waiting: list[Block] = []

    def _field(self, column: Quantity) -> Any:
        facts = {"unit": column.unit, "quantity": json.dumps(asdict(column))}
        kind = "string" if column.kind in TEXT_KINDS else "float64"
        kind = "int64" if column.kind in WHOLE else kind
        return self._arrow.field(column.name, self._arrow.type_for_alias(kind), metadata=facts)

    def add(self, block: Block) -> None:
        """See ``Store``."""
        self._waiting.append(block)
        self._rows += len(block)
        if self._rows >= _ROWS_OF_A_GROUP:
            self._write()

    def _write(self) -> None:
        block = Block.joined(self._waiting, len(self._columns))
        self._waiting, self._rows = [], 0
        cells = block.cells(self._columns)
        arrays = [self._arrow.array(values, from_pandas=False) for values in cells]
        faults = [block.faults.get(number) for number in range(len(block))]
        table = [*arrays, self._arrow.array(faults, self._arrow.string())]
        self._writer.write_table(self._arrow.table(table, schema=self._schema))

    def close(self) -> None:
        """See ``Store``."""
        if not self._file.closed:
            if self._waiting:
                self._write()
            self._writer.close()
            self._file.close()
