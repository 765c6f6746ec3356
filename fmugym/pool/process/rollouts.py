"""Rollouts of worker processes: each does all steps of its block, compiled hooks included.

The rows that programs read and write are memory of the parent. So a worker gets the programs with
numbers in the place of rows, and makes rows of its own. Their values come with each rollout.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym import _native
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.native import NativePool
from fmugym.pool.process.shared_memory import Arrays

__all__ = ["Departure", "Play", "PlayOfWorkers", "RollingWorker"]

Rows = Sequence[npt.NDArray[Any]]
CountArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Play:
    """What ``NativePool.prepare_play`` takes, in a form that other processes understand.

    Rows are numbers. First come the rows of the inputs, of the outputs, and of the outputs before a
    step; then the counts of steps; then other rows.

    Attributes:
        programs: As ``Program.with_rows`` makes them.
        actions: How actions are checked and kept, without the memory.
        copies: Pairs of rows.
        types: Those of the other rows.
        reads_kept: As for ``NativePool.prepare_play``.
        limit: Steps after which an episode is truncated.
    """

    programs: tuple[tuple[Any, ...], ...]
    actions: dict[str, Any]
    copies: tuple[tuple[int, int], ...]
    types: tuple[np.dtype[Any], ...]
    reads_kept: bool
    limit: int


@dataclass(frozen=True)
class Departure:
    """Where the episodes of a block are when a rollout begins, and what it does.

    Attributes:
        rows: The values of the outputs before the last step, and of other rows.
        last_actions: The actions of the last step and of the one before.
        actions: The actions, steps first, then environments.
        seen: The arrays of an observation: the shape of one environment's part, and the type.
        is_whole: Whether the pool makes the observation, which is a single array.
    """

    rows: list[npt.NDArray[Any]]
    last_actions: list[npt.NDArray[Any]]
    actions: npt.NDArray[Any]
    seen: list[tuple[tuple[int, ...], np.dtype[Any]]]
    is_whole: bool


class PlayOfWorkers:
    """The parent's side: describes what was prepared, and where the episodes are.

    Args:
        arrays: Those of all instances, in the shared memory.
        parts: The arguments of ``NativePool.prepare_play``, from the programs on.

    Attributes:
        play: The description.
        counts: The steps of each episode, shape (N,).
    """

    def __init__(self, arrays: Arrays, parts: Sequence[Any]) -> None:
        programs, actions, _, _, (self.counts, _, limit), surroundings = parts
        self._kept: FloatArray = surroundings["kept"]
        self._actions = actions
        self._others: list[npt.NDArray[Any]] = []
        rows = *arrays.inputs, *arrays.outputs, *self._kept, self.counts
        self._numbers = {_address(row): number for number, row in enumerate(rows)}
        self.play = Play(
            programs=tuple(self._portable(program) for program in programs),
            actions=actions | {"current": None, "previous": None},
            copies=tuple(
                (self._number(now), self._number(before)) for now, before in surroundings["copies"]
            ),
            types=tuple(row.dtype for row in self._others),
            reads_kept=surroundings["reads_kept"],
            limit=limit,
        )

    def _portable(self, program: tuple[Any, ...]) -> tuple[Any, ...]:
        code, constants, slots, rows, *rest = program
        return code, constants, slots, tuple(map(self._number, rows)), *rest

    def _number(self, row: npt.NDArray[Any]) -> int:
        key = _address(row)
        if key not in self._numbers:
            self._numbers[key] = len(self._numbers)
            self._others.append(row)
        return self._numbers[key]

    def departure(self, block: slice, actions: npt.NDArray[Any], seen: Any) -> Departure:
        """What the worker of a block needs to know.

        Args:
            block: The indices of its instances.
            actions: Of all instances, steps first.
            seen: The array that the pool makes of the observations of all steps, or a tuple of
                those that the programs store.
        """
        n = len(self.counts)
        last = (self._actions["current"], self._actions["previous"])
        arrays = seen if isinstance(seen, tuple) else (seen,)
        return Departure(
            [row[block] for row in (*self._kept, *self._others)],
            [array.reshape(n, -1)[block].reshape(-1) for array in last if array is not None],
            np.ascontiguousarray(actions[:, block]),
            [(array.shape[2:], array.dtype) for array in arrays],
            not isinstance(seen, tuple),
        )


def _address(row: npt.NDArray[Any]) -> int:
    return int(row.__array_interface__["data"][0])


class RollingWorker:
    """The worker's side.

    Args:
        pool: The worker's own.
        play: What surrounds its steps.
        counts: The steps of each of its episodes; they change in each step.
    """

    def __init__(self, pool: NativePool, play: Play, counts: CountArray) -> None:
        n = pool.num_instances
        self._pool = pool
        kept = np.zeros_like(pool.outputs)
        others = [np.zeros(n, dtype) for dtype in play.types]
        self._given = [*kept, *others]
        rows = [*pool.inputs, *pool.outputs, *kept, counts, *others]
        none = play.actions["none"]
        self._last_actions = [np.zeros(n * none.size, none.dtype) for _ in range(2)]
        current, previous = self._last_actions
        pool.prepare_play(
            (),
            (_local(play.programs[0], rows), _local(play.programs[1], rows)),
            play.actions | {"current": current, "previous": previous},
            np.zeros((0, n)),
            (_native.Draws(b"", b"", 0), np.zeros((n, 6), np.uint64)),
            (counts, np.zeros(n, np.bool_), play.limit),
            {
                "kept": kept,
                "done": None,
                "reads_kept": play.reads_kept,
                "copies": tuple((rows[now], rows[before]) for now, before in play.copies),
                "input_starts": ((-1, 0.0),) * len(pool.inputs),  # no episode starts
                "drawn_variables": (),
                "variable_starts": (),
                "results": None,
            },
        )

    def roll_out(self, start: Departure) -> tuple[int, tuple[npt.NDArray[Any], ...]]:
        """Do all steps.

        Returns:
            How many instances or numbers were in trouble; and the arrays of the observations,
            rewards, terminated and truncated, with the steps on the first axis.

        Raises:
            IndexError: If a hook looks up an index outside of its table.
        """
        for row, values in zip(self._given, start.rows, strict=True):
            row[:] = values
        for array, values in zip(self._last_actions, start.last_actions, strict=False):
            array[:] = values
        n = self._pool.num_instances
        shape = len(start.actions), n
        seen = tuple(np.empty((*shape, *part), dtype) for part, dtype in start.seen)
        flags: tuple[MaskArray, ...] = np.empty(shape, np.bool_), np.empty(shape, np.bool_)
        judged = np.empty(shape), *flags
        arrays = seen[0] if start.is_whole else seen
        troubled = self._pool.roll_out(start.actions, arrays, *judged)
        return troubled, (*seen, *judged)


def _local(program: tuple[Any, ...], rows: Rows) -> tuple[Any, ...]:
    """A program of this process."""
    code, constants, slots, numbers, *rest = program
    return code, constants, slots, tuple(rows[number] for number in numbers), *rest
