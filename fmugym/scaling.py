"""Scaling of actions from -1 to 1 to the whole ranges of a task's actions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

__all__ = ["are_scaled", "can_be_scaled", "scaled_space", "unscaled"]


def can_be_scaled(space: spaces.Space[Any]) -> bool:
    """Whether actions have ranges other than -1 to 1, and all of them end."""
    return isinstance(space, spaces.Box) and space.is_bounded() and not _is_unit(space)


def are_scaled(own: spaces.Space[Any], space: spaces.Space[Any]) -> bool:
    """Whether the actions of an agent, from -1 to 1, stand for the ranges of a task's actions.

    Args:
        own: The action space of the agent.
        space: Space of the task.
    """
    is_unit = isinstance(own, spaces.Box) and _is_unit(own)
    return is_unit and own.shape == space.shape and can_be_scaled(space)


def _is_unit(space: spaces.Box) -> bool:
    return bool(np.all(space.low == -1.0) and np.all(space.high == 1.0))


def scaled_space(space: Any) -> spaces.Box:
    """The space of actions from -1 to 1 for a task's actions."""
    return spaces.Box(-1.0, 1.0, space.shape, np.float32)


def unscaled(actions: npt.NDArray[Any], space: Any) -> npt.NDArray[Any]:
    """The actions of the task for actions from -1 to 1, shape (..., *space.shape)."""
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    inside = np.clip(low + (high - low) * (np.asarray(actions, np.float64) + 1.0) / 2, low, high)
    found: npt.NDArray[Any] = inside.astype(space.dtype)
    return found
