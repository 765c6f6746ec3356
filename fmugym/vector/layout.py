"""The arrays that a compiled step fills, and the observations and infos in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.pool.base import MaskArray
from fmugym.vector.hooks.task_programs import TaskPrograms
from fmugym.vector.info_arrays import coded, mapped, with_masks

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
        self._paths = [array.path for array in task.seen]
        self.shapes = tuple(((count, *array.shape), array.dtype) for array in task.seen)
        if not task.seen and env._conversions.pool_observes:
            self._paths = [("observation",)]
            self.shapes = (((count, env.interface.output_count), np.dtype(np.float32)),)
        self.is_plain = self._paths == [("observation",)]
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
        tree = self._tree(arrays)
        infos = tree.get("info", {})
        told = with_masks(infos, self._everywhere) if mask is None else coded(infos, mask)
        return tree.get("observation", {}), told

    def _tree(self, arrays: Sequence[Any]) -> dict[str, Any]:
        """Dicts of the arrays by their paths."""
        tree: dict[str, Any] = {}
        for path, array in zip(self._paths, arrays, strict=True):
            *parents, name = path
            place = tree
            for parent in parents:
                place = place.setdefault(parent, {})
            place[name] = array
        return tree


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
        tree = self._tree(arrays)
        return mapped(_first, tree.get("observation", {})), mapped(_first, tree.get("info", {}))


def _first(array: npt.NDArray[Any]) -> Any:
    """An array without its first axis of one; if it has no other, a number."""
    return array[0].copy() if array.ndim > 1 else array.item()
