"""The observations of N environments, which come one after another, in one array or in several."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array

from fmugym.errors import ConfigError, shown

__all__ = ["ArrayStack", "Stack", "make_stack"]


class ArrayStack:
    """The observations of a space whose elements are arrays.

    An observation is copied when it comes, so that the memory of a hook's array serves the next
    hook.

    Args:
        space: The observation space of one environment.
        count: N.

    Attributes:
        put: Places the observation of one environment, by its index. It raises ``ConfigError`` if
            that is no element of the space.
    """

    def __init__(self, space: spaces.Space[Any], count: int) -> None:
        self._space = space
        self._array = _empty(space, count)
        self._shape, self._dtype = self._array.shape[1:], self._array.dtype
        self.put = self._make_put()

    def _make_put(self) -> Callable[[int, Any], None]:
        """Make a function whose look-ups take less time than those of a method."""
        array, shape, dtype, convert = self._array, self._shape, self._dtype, self._converted

        def put(index: int, observation: Any) -> None:
            is_array = type(observation) is np.ndarray
            if is_array and observation.dtype is dtype and observation.shape == shape:
                array[index] = observation
            else:
                array[index] = convert(observation)

        return put

    def _converted(self, observation: Any) -> Any:
        try:
            if self._dtype.kind == "f" or type(observation) is int:
                array = np.asarray(observation, self._dtype)
                if array.shape == self._shape:
                    return array
            stacked: Any = concatenate(self._space, [observation], _empty(self._space, 1))
            return stacked[0]
        except Exception:  # users' observations may raise anything
            raise _misfit(observation, self._space) from None

    def put_all(self, observations: npt.NDArray[Any]) -> None:
        """Place the observations of all environments, an array of the type of the space."""
        self._array[...] = observations

    def copied(self) -> Any:
        """A copy of all observations."""
        return self._array.copy()


class DictStack:
    """The observations of a dict of spaces; see ``ArrayStack``."""

    def __init__(self, space: spaces.Dict, count: int) -> None:
        self._space = space
        self._parts = {name: make_stack(part, count) for name, part in space.spaces.items()}
        self._puts = tuple((name, part.put) for name, part in self._parts.items())

    def put(self, index: int, observation: Any) -> None:
        """See ``ArrayStack.put``."""
        for name, put in self._puts:
            try:
                value = observation[name]
            except Exception:  # users' observations may raise anything
                raise _misfit(observation, self._space) from None
            put(index, value)

    def copied(self) -> Any:
        """See ``ArrayStack.copied``."""
        return {name: part.copied() for name, part in self._parts.items()}


class ItemStack:
    """The observations of any other space; see ``ArrayStack``."""

    def __init__(self, space: spaces.Space[Any], count: int) -> None:
        self._space = space
        self._items: list[Any] = [None] * count

    def put(self, index: int, observation: Any) -> None:
        """See ``ArrayStack.put``; nothing is copied before ``copied``."""
        self._items[index] = observation

    def copied(self) -> Any:
        """See ``ArrayStack.copied``.

        Raises:
            ConfigError: If one of them is no element of the space.
        """
        try:
            return concatenate(self._space, self._items, _empty(self._space, len(self._items)))
        except Exception:  # users' observations may raise anything
            raise _misfit(self._items[0], self._space) from None


Stack = ArrayStack | DictStack | ItemStack
"""The observations of N environments."""


def make_stack(space: spaces.Space[Any], count: int) -> Stack:
    """Make the place for the observations of N environments with this observation space."""
    if isinstance(space, spaces.Dict):
        return DictStack(space, count)
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
        return ArrayStack(space, count)
    return ItemStack(space, count)


def _misfit(observation: Any, space: spaces.Space[Any]) -> ConfigError:
    return ConfigError(
        f"_get_observation returned {shown(observation)}, which is no element of {space}"
    )


def _empty(space: spaces.Space[Any], count: int) -> Any:
    return create_empty_array(space, n=count, fn=np.zeros)
