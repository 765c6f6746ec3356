"""The arrays of observations and infos that a step or the start of episodes fills."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from fmugym.env import FMUEnv
from fmugym.pool.base import MaskArray
from fmugym.vector.codec import coded, with_masks
from fmugym.vector.hooks.task_programs import TaskPrograms

__all__ = ["Arrays", "Layout"]

Arrays = tuple[Any, ...]
"""Those of observations and infos, environments first."""


class Layout:
    """The arrays that the pool or a program fills, and the observations and infos in them.

    Args:
        task: The programs.
        env: The environment.
        count: N.

    Attributes:
        shapes: The shape and type of each array.
        observes: Whether the pool fills the observations, and no program does.
        is_plain: Whether there is one array, that of the observations.
    """

    def __init__(self, task: TaskPrograms, env: FMUEnv, count: int) -> None:
        self._paths = [array.path for array in task.seen]
        self.shapes = [((count, *array.shape), array.dtype) for array in task.seen]
        self.observes = not task.seen and env.inside.pool_observes
        if self.observes:
            self._paths = [("observation",)]
            self.shapes = [((count, env.inside.output_count), np.dtype(np.float32))]
        self.is_plain = self._paths == [("observation",)]
        self._all = np.ones(count, np.bool_)

    def new(self) -> Arrays:
        """New arrays to be filled."""
        return tuple([np.empty(shape, dtype) for shape, dtype in self.shapes])

    def observations(self, arrays: Arrays) -> Any:
        """The observations: an array, or a dict of arrays."""
        return arrays[0] if self.is_plain else self.nested(arrays)["observation"]

    def infos_of_step(self, arrays: Arrays) -> dict[str, Any]:
        """The infos of all environments."""
        return {} if self.is_plain else with_masks(self.nested(arrays)["info"], self._all)

    def infos(self, arrays: Arrays, mask: MaskArray) -> dict[str, Any]:
        """The infos of some environments."""
        return {} if self.is_plain else coded(self.nested(arrays)["info"], mask)

    def nested(self, arrays: Iterable[Any]) -> dict[str, Any]:
        """The arrays in the places of observations and infos."""
        tree: dict[str, Any] = {"observation": {}, "info": {}}
        for path, array in zip(self._paths, arrays, strict=True):
            *parents, name = path
            place = tree
            for parent in parents:
                place = place.setdefault(parent, {})
            place[name] = array
        return tree
