"""Rollouts of worker processes: each does all steps of its block, compiled hooks included.

The rows that programs read and write are memory of this process. So a worker gets numbers in the
place of rows, and has rows of its own. Their values come with each rollout. ``native/worker``
reads what is written here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.form import Writer
from fmugym.pool.process.requests import DamagedError, Reader
from fmugym.pool.process.shared_memory import Arrays

__all__ = ["PlayOfWorkers", "Rolled", "read_rolled"]

Rows = Sequence[npt.NDArray[Any]]

_OUTSIDE: Final = -1
"""In the place of a number of instances: a hook has looked up an index outside of its table."""


class Rolled(NamedTuple):
    """What a rollout of a block has led to.

    Attributes:
        troubled: How many instances or numbers were in trouble.
        is_outside: Whether a hook has looked up an index outside of its table.
        arrays: The observations, rewards, terminated and truncated, with the steps on the first
            axis.
    """

    troubled: int
    is_outside: bool
    arrays: tuple[npt.NDArray[Any], ...]


class PlayOfWorkers:
    """Describes what was prepared, and where the episodes are.

    Rows are numbers. First come the rows of the inputs, of the outputs, and of the outputs before a
    step; then the counts of steps; then other rows.

    Args:
        arrays: Those of all instances, in the shared memory.
        parts: The arguments of ``NativePool.prepare_play``, from the programs on.

    Attributes:
        counts: The steps of each episode, shape (N,).
    """

    def __init__(self, arrays: Arrays, parts: Sequence[Any]) -> None:
        programs, actions, _, _, (self.counts, _, limit), surroundings = parts
        self._kept: FloatArray = surroundings["kept"]
        self._actions = actions
        self._others: list[npt.NDArray[Any]] = []
        rows = *arrays.inputs, *arrays.outputs, *self._kept, self.counts
        self._numbers = {_address(row): number for number, row in enumerate(rows)}
        copies = [list(map(self._number, pair)) for pair in surroundings["copies"]]
        numbers = [list(map(self._number, rows)) for _, rows in programs]
        writer = Writer()
        writer.integers(surroundings["reads_kept"], limit)
        _write_actions(writer, actions)
        writer.array([row.itemsize for row in self._others], np.int64)
        writer.array(copies, np.int64)
        for (form, _), own in zip(programs, numbers, strict=True):
            writer.block(form)
            writer.array(own, np.int64)
        self._play = writer.form()

    def _number(self, row: npt.NDArray[Any]) -> int:
        key = _address(row)
        if key not in self._numbers:
            self._numbers[key] = len(self._numbers)
            self._others.append(row)
        return self._numbers[key]

    def request(
        self, block: slice, actions: npt.NDArray[Any], offsets: FloatArray, *, is_known: bool
    ) -> bytes:
        """The content of a request.

        Args:
            block: The indices of the worker's instances.
            actions: Of all instances, steps first.
            offsets: What is added to the outputs; empty for nothing.
            is_known: Whether the worker knows what was prepared.
        """
        writer = Writer()
        writer.integers(not is_known)
        if not is_known:
            writer.block(self._play)
        writer.integers(len(actions))
        writer.block(np.ascontiguousarray(actions[:, block]).tobytes())
        writer.array(offsets, np.float64)
        for row in (*self._kept, *self._others):
            writer.block(row[block].tobytes())
        for array in (self._actions["current"], self._actions["previous"]):
            if array is not None:
                writer.block(array.reshape(len(self.counts), -1)[block].tobytes())
        return writer.form()


def _write_actions(writer: Writer, actions: Mapping[str, Any]) -> None:
    none = actions["none"]
    writer.integers(none.size, none.itemsize)
    writer.integers(*(int(actions[name]) for name in ("check", "lowest", "highest")))
    writer.integers(actions["current"] is not None)
    writer.block(none.tobytes())


def _address(row: npt.NDArray[Any]) -> int:
    return int(row.__array_interface__["data"][0])


def read_rolled(reader: Reader, count: int, arrays: Sequence[npt.NDArray[Any]]) -> Rolled:
    """Read the answer to a rollout.

    Args:
        reader: Reads it.
        count: The number of the worker's instances.
        arrays: Those of all instances, which are of the same types.
    """
    troubled = reader.integer()
    if troubled < _OUTSIDE:
        raise DamagedError(f"{troubled} instances in trouble")
    found = tuple(_read_like(reader, count, array) for array in arrays)
    reader.end()
    return Rolled(max(0, troubled), troubled == _OUTSIDE, found)


def _read_like(reader: Reader, count: int, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    shape = len(array), count, *array.shape[2:]
    if array.dtype != np.bool_:
        return reader.array(shape, array.dtype)
    flags: MaskArray = reader.array(shape, np.uint8) != 0  # a byte may be anything
    return flags
