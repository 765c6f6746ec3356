"""Observations of any numeric space as rows of numbers, and how many numbers choose an action."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces

from fmugym.errors import ConfigError
from fmugym.pool.base import FloatArray

__all__ = ["choices_of", "flattened_observations", "require_numbers"]


def flattened_observations(space: spaces.Space[Any], observations: Any, count: int) -> FloatArray:
    """Flatten N observations as ``gymnasium.spaces.flatten`` does each: shape (N, k).

    Args:
        space: The space of one observation.
        observations: A batch of N, or one observation if N is 1.
        count: N.
    """
    columns = []
    for part, values in _parts(space, observations):
        rows = np.asarray(values, np.float64).reshape(count, -1)
        if isinstance(part, spaces.Discrete | spaces.MultiDiscrete):
            pairs = zip(rows.T, choices_of(part), strict=True)
            columns += [1.0 * (row[:, None] == np.array(choice)) for row, choice in pairs]
        else:
            columns.append(rows)
    return np.concatenate(columns, axis=1)


def _parts(space: Any, values: Any = None) -> Iterator[tuple[Any, Any]]:
    """The spaces within Dicts and Tuples, each with its part of a batch."""
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        yield space, values
        return
    for key, part in space.items() if isinstance(space, spaces.Dict) else enumerate(space):
        yield from _parts(part, None if values is None else values[key])


def choices_of(space: Any) -> list[range]:
    """The elements to choose from, for each part of an action; empty if actions are numbers."""
    if isinstance(space, spaces.Box):
        return []
    if isinstance(space, spaces.MultiBinary):
        return [range(2)] * int(np.prod(space.shape))
    counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
    return [range(int(start), int(start + n)) for start, n in np.broadcast(space.start, counts)]


def require_numbers(observed: spaces.Space[Any], acting: spaces.Space[Any]) -> None:
    """Refuse spaces for which no policy can be searched.

    Raises:
        ConfigError: For images, texts and the like, and for actions without limits; the text has
            the cure.
    """
    kinds = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
    for part, _ in _parts(observed):
        if not isinstance(part, kinds) or len(part.shape or ()) > 1:
            raise ConfigError(
                f"a search needs numbers to observe, and {part} has none: give numbers by a hook, "
                "or train with --algorithm PPO"
            )
    if not isinstance(acting, kinds):
        raise ConfigError(f"a search needs a Box or Discrete of actions, got {acting}: flatten it")
    if isinstance(acting, spaces.Box) and not acting.is_bounded():
        raise ConfigError(
            f"a search needs actions with limits, got {acting}: give 'bounds' in the config, or "
            "'min' and 'max' in the task file"
        )
