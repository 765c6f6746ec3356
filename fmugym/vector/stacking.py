"""The observations of N environments, which come one after another, in one array or in several."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array

from fmugym.errors import ConfigError, shown
from fmugym.pool.base import MaskArray
from fmugym.signals import ordinary

__all__ = ["PoolStack", "Stack", "make_stack"]


class PoolStack:
    """The observations that the pool writes itself.

    Args:
        observations: Those of the pool, shape (N, k).
    """

    def __init__(self, observations: npt.NDArray[np.float32]) -> None:
        self._source, self._array = observations, observations.copy()

    def refresh(self) -> None:
        """Take those of the last step of the pool."""
        self._array[...] = self._source

    def put(self, index: int, observation: npt.NDArray[np.float32]) -> None:
        """Place the observation of one environment, if it is not that of the pool."""
        self._array[index] = observation

    def take(self, index: int, observation: Any) -> bool:
        """See ``ArrayStack.take``."""
        return False

    def row(self, index: int) -> npt.NDArray[np.float32]:
        """A copy of the observation of one environment."""
        row: npt.NDArray[np.float32] = self._array[index].copy()
        return row

    def joined(self) -> npt.NDArray[np.float32]:
        """All observations, in a new array."""
        return self._array.copy()

    def finite(self) -> MaskArray:
        """Which observations have finite numbers only, shape (N,)."""
        return _finite_rows(self._array)


class ArrayStack:
    """The observations of a space whose elements are arrays.

    An observation is copied when it comes, so that the memory of a hook's array serves the next
    hook. It is kept as bytes: to join these takes less time than to write rows of an array.

    Args:
        space: The observation space of one environment.
        count: N.
    """

    def __init__(self, space: spaces.Space[Any], count: int) -> None:
        empty = _empty(space, count)
        self._space, self._shape, self._dtype = space, empty.shape[1:], empty.dtype
        self._rows: list[bytes] = [row.tobytes() for row in empty]

    def take(self, index: int, observation: Any) -> bool:
        """Place an observation of the type and shape of the space; False if it is another.

        Its numbers need not be finite; see ``finite``.
        """
        if type(observation) is not np.ndarray or observation.dtype is not self._dtype:
            return False
        if observation.shape != self._shape:
            return False
        self._rows[index] = observation.tobytes()
        return True

    def put(self, index: int, observation: Any) -> None:
        """Place the observation of one environment.

        Raises:
            ConfigError: If that is no element of the space.
        """
        if not self.take(index, observation):
            self._rows[index] = self._converted(observation).tobytes()

    def _converted(self, observation: Any) -> Any:
        try:
            if self._dtype.kind == "f" or type(observation) is int:
                array = np.asarray(observation, self._dtype)
                if array.shape == self._shape:
                    return array
            stacked: Any = concatenate(self._space, [observation], _empty(self._space, 1))
            return stacked[0]
        except ordinary(Exception):  # users' observations may raise anything
            raise _misfit(observation, self._space) from None

    def row(self, index: int) -> npt.NDArray[Any]:
        """A copy of the observation of one environment."""
        return np.ndarray(self._shape, self._dtype, bytearray(self._rows[index]))

    def joined(self) -> npt.NDArray[Any]:
        """All observations, in a new array."""
        shape = len(self._rows), *self._shape
        return np.ndarray(shape, self._dtype, bytearray().join(self._rows))

    def finite(self) -> MaskArray:
        """Which observations have finite numbers only, shape (N,)."""
        return _finite_rows(self.joined())


class DictStack:
    """The observations of a dict of spaces; see ``ArrayStack``."""

    def __init__(self, space: spaces.Dict, count: int) -> None:
        self._space, self._count = space, count
        self._parts = {name: make_stack(part, count) for name, part in space.spaces.items()}
        self._takes = tuple((name, part.take) for name, part in self._parts.items())

    def take(self, index: int, observation: Any) -> bool:
        """See ``ArrayStack.take``."""
        if type(observation) is not dict or len(observation) != len(self._takes):
            return False
        for name, take in self._takes:  # noqa: SIM110  (``all`` takes longer)
            if not take(index, observation.get(name)):
                return False
        return True

    def put(self, index: int, observation: Any) -> None:
        """See ``ArrayStack.put``."""
        for name, part in self._parts.items():
            try:
                value = observation[name]
            except ordinary(Exception):  # users' observations may raise anything
                raise _misfit(observation, self._space) from None
            part.put(index, value)

    def row(self, index: int) -> dict[str, Any]:
        """See ``ArrayStack.row``."""
        return {name: part.row(index) for name, part in self._parts.items()}

    def joined(self) -> dict[str, Any]:
        """See ``ArrayStack.joined``."""
        return {name: part.joined() for name, part in self._parts.items()}

    def finite(self) -> MaskArray:
        """See ``ArrayStack.finite``."""
        masks = [part.finite() for part in self._parts.values()]
        return np.all(masks, axis=0) if masks else np.ones(self._count, np.bool_)


class ItemStack:
    """The observations of any other space; see ``ArrayStack``."""

    def __init__(self, space: spaces.Space[Any], count: int) -> None:
        self._space = space
        self._items: list[Any] = [None] * count

    def take(self, index: int, observation: Any) -> bool:
        """See ``ArrayStack.take``; the elements of these spaces are checked one by one."""
        return False

    def put(self, index: int, observation: Any) -> None:
        """See ``ArrayStack.put``; nothing is copied before ``joined``."""
        self._items[index] = observation

    def row(self, index: int) -> Any:
        """See ``ArrayStack.row``; the same object."""
        return self._items[index]

    def joined(self) -> Any:
        """See ``ArrayStack.joined``.

        Raises:
            ConfigError: If one of them is no element of the space.
        """
        try:
            return concatenate(self._space, self._items, _empty(self._space, len(self._items)))
        except ordinary(Exception):  # users' observations may raise anything
            raise _misfit(self._items[0], self._space) from None

    def finite(self) -> MaskArray:
        """See ``ArrayStack.finite``; ``take`` has left that to others."""
        return np.ones(len(self._items), np.bool_)


Stack = ArrayStack | DictStack | ItemStack
"""The observations of N environments."""


def make_stack(space: spaces.Space[Any], count: int) -> Stack:
    """Make the place for the observations of N environments with this observation space."""
    if isinstance(space, spaces.Dict):
        return DictStack(space, count)
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
        return ArrayStack(space, count)
    return ItemStack(space, count)


def _finite_rows(array: npt.NDArray[Any]) -> MaskArray:
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return np.ones(len(array), np.bool_)
    finite: MaskArray = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    return finite


def _misfit(observation: Any, space: spaces.Space[Any]) -> ConfigError:
    return ConfigError(
        f"_get_observation returned {shown(observation)}, which is no element of {space}"
    )


def _empty(space: spaces.Space[Any], count: int) -> Any:
    return create_empty_array(space, n=count, fn=np.zeros)
