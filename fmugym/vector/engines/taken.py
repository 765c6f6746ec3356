"""The actions that N environments have taken, which are asked one after another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any, Final, NamedTuple

from fmugym.pool.base import FloatArray

__all__ = ["Taken", "in_time"]

_AT_ONCE: Final = 64
"""The numbers of so many environments stay in the processor's caches until hooks read them."""


class Taken(NamedTuple):
    """The inputs of the environments whose FMUs step.

    Attributes:
        indices: The M environments.
        rows: Their inputs, shape (M, k).
        actions: The actions of all N environments if these M do not know theirs yet, or None.
    """

    indices: list[int]
    rows: FloatArray
    actions: Sequence[Any] | None


def in_time(columns: FloatArray) -> Iterator[tuple[float, ...]]:
    """The columns of an array as tuples of Python's floats, each made shortly before it is read."""
    starts = range(0, columns.shape[1], _AT_ONCE)
    return chain.from_iterable(
        map(tuple, columns[:, start : start + _AT_ONCE].T.tolist()) for start in starts
    )
