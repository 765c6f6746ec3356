"""Rollouts of worker processes: each does all steps of its block, programs included.

The rows that programs read and write are memory of this process. So a worker gets numbers in the
place of rows, and has rows of its own. Their values come with each rollout. ``native/worker``
reads what is written here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.pool.base import FloatArray
from fmugym.pool.form import Writer
from fmugym.pool.health import Arrays
from fmugym.pool.play_form import Rows, form_of_play
from fmugym.pool.requests import DamagedError, Reader

__all__ = ["OUTSIDE", "PlayOfWorkers", "read_rolled"]

OUTSIDE: Final = -1
"""In the place of a number of instances: a hook has looked up an index outside of its table."""


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
        programs, self._actions, _, _, (self.counts, _, limit), surroundings = parts
        self._kept: FloatArray = surroundings["kept"]
        rows = Rows([*arrays.inputs, *arrays.outputs, *self._kept, self.counts])
        known = len(rows.arrays)
        starts: dict[str, tuple[()]] = {"variable_starts": (), "drawn_variables": ()}
        form = form_of_play(rows, programs, self._actions, limit, surroundings | starts)
        self._others = rows.arrays[known:]
        sizes = [row.itemsize for row in self._others]
        self._play = Writer().array(sizes, np.int64).block(form).form()

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
        writer = Writer().integers(not is_known)
        writer.forms(b"" if is_known else self._play).integers(len(actions))
        writer.block(np.ascontiguousarray(actions[:, block]).tobytes())
        writer.array(offsets, np.float64)
        for row in (*self._kept, *self._others):
            writer.block(row[block].tobytes())
        for array in (self._actions["current"], self._actions["previous"]):
            if array is not None:
                writer.block(array.reshape(len(self.counts), -1)[block].tobytes())
        return writer.form()


def read_rolled(reader: Reader, block: slice, arrays: Sequence[npt.NDArray[Any]]) -> int:
    """Read the answer to a rollout.

    Args:
        reader: Reads it.
        block: The indices of the worker's instances.
        arrays: The observations, rewards, terminated and truncated of all instances, with the steps
            on the first axis. Those of the worker's are filled.

    Returns:
        How many instances or numbers were in trouble, or ``OUTSIDE``.
    """
    troubled = reader.integer()
    if troubled < OUTSIDE:
        raise DamagedError(f"{troubled} instances in trouble")
    for array in arrays:
        part = array[:, block]
        is_flag = array.dtype == np.bool_
        found = reader.array(part.shape, np.uint8 if is_flag else array.dtype)
        part[...] = found != 0 if is_flag else found  # a byte may be anything
    reader.end()
    return troubled
