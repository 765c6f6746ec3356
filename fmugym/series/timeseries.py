"""Time series of episodes: a table whose columns have names, units and meanings."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.checks import Spellings, check_path
from fmugym.errors import ConfigError, shown
from fmugym.extras import imported
from fmugym.pool.base import FloatArray
from fmugym.series.store import FAULT, WHOLE, open_store
from fmugym.task.quantity import Quantity

__all__ = ["TimeSeries"]


@dataclass(frozen=True)
class TimeSeries:
    """Table that a recorder has written, one row for each moment.

    Attributes:
        columns: What the columns are. Beside the kinds of ``fmugym.task.quantity``, there are
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
        """The values of each column in their own type."""
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
