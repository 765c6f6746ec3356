"""Observations of any numeric space as rows of numbers, and how many numbers choose an action."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces

from fmugym.baselines.base import FloatArray

__all__ = ["choices_of", "rows_of", "width_of"]


def rows_of(space: spaces.Space[Any], observations: Any, count: int) -> FloatArray:
    """Flatten N observations as ``gymnasium.spaces.flatten`` does each: shape (N, k).

    Args:
        space: The space of one observation.
        observations: A batch of N, or one observation if N is 1.
        count: N.
    """
    return np.concatenate(list(_columns(space, observations, count)), axis=1)


def _columns(space: Any, values: Any, count: int) -> Iterator[FloatArray]:
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts: Any = space.items() if isinstance(space, spaces.Dict) else enumerate(space)
        for key, part in parts:
            yield from _columns(part, values[key], count)
        return
    rows = np.asarray(values, np.float64).reshape(count, -1)
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        yield rows
        return
    for row, choice in zip(rows.T, choices_of(space), strict=True):
        yield (row[:, np.newaxis] == np.array(choice)).astype(np.float64)


def width_of(space: spaces.Space[Any]) -> int:
    """The number k of ``rows_of``."""
    return int(spaces.flatdim(space))


def choices_of(space: Any) -> list[range]:
    """The elements to choose from, for each part of an action; empty if actions are numbers."""
    if isinstance(space, spaces.Discrete):
        return [range(int(space.start), int(space.start + space.n))]
    if isinstance(space, spaces.MultiDiscrete):
        pairs = zip(space.start.flat, space.nvec.flat, strict=True)
        return [range(int(start), int(start + n)) for start, n in pairs]
    if isinstance(space, spaces.MultiBinary):
        return [range(2)] * int(np.prod(space.shape))
    return []
