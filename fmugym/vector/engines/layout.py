"""The arrays that a compiled step fills, and the observations and infos in them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.vector.codec import mapped, with_masks
from fmugym.vector.hooks.trace import TracedTask

__all__ = ["Layout"]


class Layout:
    """The arrays that a program or the pool fills, and the observations and infos in them.

    Args:
        task: The programs.
        env: The environment.
        count: N.

    Attributes:
        shapes: The shape and type of each array.
        names: None if the observations are the only array; the keys if they are a dict; otherwise
            empty.
        form: That of the observations and that of the infos, as the pool takes them: the number of
            an array, or a tuple of names and forms.
        divided: Returns the observations and a new dict of infos that such arrays hold. None if
            what ``new_arrays`` makes are the observations.
    """

    def __init__(self, task: TracedTask, env: FMUEnv, count: int) -> None:
        self._n = count
        self._paths = [array.path for array in task.seen]
        self.shapes = tuple(((self._n, *array.shape), array.dtype) for array in task.seen)
        self.names: tuple[str, ...] | None = ()
        self.divided: Callable[[Any], tuple[Any, dict[str, Any]]] | None = self._tree
        if not task.seen and env.inside.pool_observes:
            self.shapes = (((self._n, env.inside.output_count), np.dtype(np.float32)),)
            self.names, self.divided = None, None
        elif self._paths == [("observation",)]:
            self.names, self.divided = None, None
        elif task.seen and all(path[0] == "observation" and len(path) == 2 for path in self._paths):
            self.names, self.divided = tuple(path[-1] for path in self._paths), None

        observations, infos = self._nested(range(len(self._paths)))
        self.form = 0 if self.names is None else _pairs(observations), _pairs(infos)

    def new_arrays(self, steps: int) -> Any:
        """Make the arrays of many steps: one, or a tuple or dict of those that programs store.

        Their first axis is for the steps.
        """
        arrays = tuple(np.empty((steps, *shape), dtype) for shape, dtype in self.shapes)
        if self.names is None:
            return arrays[0]
        return dict(zip(self.names, arrays, strict=True)) if self.names else arrays

    def of_one(self) -> tuple[tuple[Any, ...], Any, Callable[[Any], tuple[Any, Any]] | None]:
        """The arrays of a single environment.

        Returns:
            The shape and type of each; the form of what they are in; and what takes the observation
            and the info from there, or None if it is the observation.
        """
        if self.names is None and len(self.shapes[0][0]) > 1:
            ((_, *shape), dtype) = self.shapes[0]
            return ((tuple(shape), dtype),), 0, None
        return self.shapes, _pairs(dict(enumerate(self._nested(range(len(self._paths)))))), _of_one

    def _tree(self, arrays: Any) -> tuple[Any, dict[str, Any]]:
        """The observations and infos of any form."""
        observations, infos = self._nested(arrays)
        return observations, with_masks(infos, np.ones(self._n, np.bool_)) if infos else {}

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
