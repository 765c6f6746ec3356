"""The arrays that a compiled step fills, and the observations and infos in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.vector.codec import mapped
from fmugym.vector.hooks.task_programs import TaskPrograms

__all__ = ["Layout"]


class Layout:
    """The arrays that a program or the pool fills, and the observations and infos in them.

    Args:
        task: The programs.
        env: The environment.
        count: N.

    Attributes:
        shapes: The shape and type of each array.
        form: That of the observations and that of the infos, as the pool takes them: the number of
            an array, or a tuple of names and forms.
    """

    def __init__(self, task: TaskPrograms, env: FMUEnv, count: int) -> None:
        self._paths = [array.path for array in task.seen]
        self.shapes = tuple(((count, *array.shape), array.dtype) for array in task.seen)
        if not task.seen and env._conversions.pool_observes:
            self._paths = [("observation",)]
            self.shapes = (((count, env.interface.output_count), np.dtype(np.float32)),)
        observations, infos = self._nested(range(len(self._paths)))
        self.form = _pairs(observations), _pairs(infos)

    def of_one(self) -> tuple[tuple[Any, ...], Any, Callable[[Any], tuple[Any, Any]] | None]:
        """The arrays of a single environment.

        Returns:
            The shape and type of each; the form of what they are in; and what takes the observation
            and the info from there, or None if it is the observation.
        """
        if self.form == (0, ()) and len(self.shapes[0][0]) > 1:
            ((_, *shape), dtype) = self.shapes[0]
            return ((tuple(shape), dtype),), 0, None
        return self.shapes, tuple(enumerate(self.form)), _of_one

    def _nested(self, leaves: Iterable[Any]) -> tuple[Any, dict[str, Any]]:
        """Something for each array, in the places of observations and infos."""
        tree: dict[str, Any] = {"observation": {}, "info": {}}
        for path, leaf in zip(self._paths, leaves, strict=True):
            *parents, name = path
            place = tree
            for parent in parents:
                place = place.setdefault(parent, {})
            place[name] = leaf
        return tree["observation"], tree["info"]


def _of_one(tree: dict[int, Any]) -> tuple[Any, Any]:
    """The observation and the info of a single environment."""
    return mapped(_first, tree[0]), mapped(_first, tree[1])


def _first(array: npt.NDArray[Any]) -> Any:
    """An array without its first axis of one; if it has no other, a number."""
    return array[0].copy() if array.ndim > 1 else array.item()


def _pairs(tree: Any) -> Any:
    """Make tuples of dicts."""
    if not isinstance(tree, dict):
        return tree
    return tuple((name, _pairs(value)) for name, value in tree.items())
