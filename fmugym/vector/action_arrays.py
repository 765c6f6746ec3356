"""Checks of the actions that ``step`` of a vector environment is given."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.errors import ConfigError, shown

__all__ = ["array_of", "checked_actions", "is_array_space"]

_ARRAY_SPACES: Final = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)


def is_array_space(space: spaces.Space[Any]) -> bool:
    """Whether elements of N environments make one array."""
    return isinstance(space, _ARRAY_SPACES)


def checked_actions(space: Any, num_envs: int, actions: Any) -> npt.NDArray[Any]:
    """Copy the actions of N environments.

    All of them are checked, also those of environments that are about to be reset: what such an
    environment does with its action does not depend on the way of calling hooks.

    Args:
        space: The action space of one environment; see ``is_array_space``.
        num_envs: N.
        actions: What the caller gave.

    Returns:
        A new array of shape (N, ...).

    Raises:
        ConfigError: If the shape or the type does not fit, an action of a ``Discrete`` is out of
            its range, or one is NaN.
    """
    array = array_of(actions)
    if array.dtype.kind not in "biuf":
        raise ConfigError(f"the actions do not make an array of numbers: {shown(actions)}")
    if array.shape != (num_envs, *space.shape):
        raise ConfigError(
            f"the actions have shape {array.shape}, expected {(num_envs, *space.shape)}"
        )
    if array.dtype.kind == "f":
        _require_numbers(array)
    if space.dtype.kind != "f":
        _require_integers(space, array)
        if array.dtype.kind == "b":
            return array.astype(space.dtype)
    return array


def array_of(value: Any) -> npt.NDArray[Any]:
    """New array of a caller's value; an empty one of objects if it makes none."""
    try:
        return np.array(value)
    except Exception:  # lists that make no array, and the user's own __array__
        return np.empty(0, object)


def _require_numbers(array: npt.NDArray[Any]) -> None:
    if np.count_nonzero(np.isnan(array)):
        index = int(np.argwhere(np.isnan(array))[0][0])
        raise ConfigError(f"the action of environment {index} is not a number: {array[index]}")


def _require_integers(space: Any, array: npt.NDArray[Any]) -> None:
    if array.dtype.kind == "f":
        raise ConfigError(f"the actions are of type {array.dtype}, expected integers")
    if isinstance(space, spaces.Discrete):
        low, high = int(space.start), int(space.start + space.n - 1)
        if low == 0 and array.dtype == np.int64 and array.view(np.uint64).max() <= high:
            return  # a negative number would be a great one
        if array.min() < low or array.max() > high:
            index = int(np.flatnonzero((array < low) | (array > high))[0])
            raise ConfigError(f"action {array[index]} of environment {index} is not in {space}")
