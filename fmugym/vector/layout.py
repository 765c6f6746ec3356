"""The arrays that a compiled step fills, and the observations and infos in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.pool.base import MaskArray
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.info_arrays import masked

__all__ = ["Layout", "LayoutOfOne"]


class Layout:
    """The arrays that a program or the pool fills, and the observations and infos in them.

    Args:
        task: The programs.
        env: The environment.
        count: N.

    Attributes:
        shapes: The shape and type of each array.
        is_plain: Whether there is one array, the observations, and there are no infos.
    """

    def __init__(self, task: TaskPrograms, env: FMUEnv, count: int) -> None:
        paths = [array.path for array in task.seen]
        self.shapes = tuple(((count, *array.shape), array.dtype) for array in task.seen)
        if not task.seen and env._conversions.pool_observes:
            paths = [("observation",)]
            self.shapes = (((count, env.interface.output_count), np.dtype(np.float32)),)
        self.is_plain = paths == [("observation",)]
        observed, told = (
            [p[1:] for p in paths if p[0] == kind] for kind in ("observation", "info")
        )
        self._observations = _Tree(observed, 0)
        self._first_info = len(observed)
        self._infos = _Tree(told, len(observed))
        self._everywhere = np.ones(count, np.bool_)

    def parts(
        self, arrays: Sequence[npt.NDArray[Any]], mask: MaskArray | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """The observations and infos in some arrays of these shapes.

        Args:
            arrays: The arrays.
            mask: The environments of the infos, shape (N,); None for all.

        Returns:
            Observations, which are {} if no program makes any; and infos.
        """
        if self.is_plain:
            return arrays[0], {}
        if mask is None:
            return self._observations.filled(arrays), self._infos.filled(arrays, self._everywhere)
        told = [masked(mask, array) for array in arrays[self._first_info :]]
        observations = self._observations.filled(arrays)
        return observations, self._infos.filled([*arrays[: self._first_info], *told], mask)


class _Tree:
    """Dicts of arrays, or a single array, in a list of arrays.

    Args:
        paths: The names that lead to each array; () for a single one.
        first: The place of the first array in the list.
    """

    def __init__(self, paths: Sequence[tuple[str, ...]], first: int) -> None:
        self._single = first if list(paths) == [()] else None
        entries: dict[tuple[str, ...], dict[str, int | None]] = {(): {}}
        for place, path in enumerate(paths, first):
            for end in range(len(path)):
                own = entries.setdefault(path[:end], {})
                own.setdefault(path[end], None if end + 1 < len(path) else place)
        order = sorted(entries, key=len, reverse=True)  # a dict comes after those that it has
        numbers = {path: number for number, path in enumerate(order)}
        self._dicts = [
            [
                (name, f"_{name}", place, numbers.get((*path, name), 0))
                for name, place in entries[path].items()
            ]
            for path in order
        ]

    def filled(self, arrays: Sequence[Any], mask: MaskArray | None = None) -> Any:
        """The dicts of these arrays; with a mask, as infos have it, for each name."""
        if self._single is not None:
            return arrays[self._single]
        made: list[dict[str, Any]] = []
        for entries in self._dicts:
            values: dict[str, Any] = {}
            for name, name_of_mask, place, number in entries:
                values[name] = made[number] if place is None else arrays[place]
                if mask is not None:
                    values[name_of_mask] = mask.copy()
            made.append(values)
        return made[-1]


class LayoutOfOne(Layout):
    """The same of a single environment; a plain array has no axis for environments.

    Args:
        task, env: See ``Layout``.
    """

    def __init__(self, task: TaskPrograms, env: FMUEnv) -> None:
        super().__init__(task, env, 1)
        self.is_plain = self.is_plain and len(self.shapes[0][0]) > 1
        if self.is_plain:
            ((_, *shape), dtype) = self.shapes[0]
            self.shapes = ((tuple(shape), dtype),)

    def of_one(self, arrays: Sequence[npt.NDArray[Any]]) -> tuple[Any, dict[str, Any]]:
        """The observation and the info in some arrays of these shapes, if these are not plain."""
        values = [_first(array) for array in arrays]
        return self._observations.filled(values), self._infos.filled(values)


def _first(array: npt.NDArray[Any]) -> Any:
    """An array without its first axis of one; if it has no other, a number."""
    return array[0].copy() if array.ndim > 1 else array.item()
