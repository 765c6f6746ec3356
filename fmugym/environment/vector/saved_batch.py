"""Saved episodes of a batch of environments, as columns of a snapshot."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.checks import integer_of
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import environments_first, environments_last
from fmugym.environment.saved_episode import READ, read_columns, require_quantities
from fmugym.environment.snapshots import Columns, Snapshot
from fmugym.errors import ConfigError, shown
from fmugym.pool.states import IndexArray

__all__ = [
    "Which",
    "batch_columns",
    "chosen",
    "place_batch",
    "place_column",
    "require_fit",
    "sources_for",
    "which_of",
]


def chosen(where: Any, num_envs: int) -> IndexArray:
    """The indices of environments.

    Args:
        where: A Boolean mask of shape (N,), an index, or a sequence of indices; None for all.
        num_envs: N.

    Raises:
        ConfigError: If it fits none of these, or is empty, or names an environment twice.
    """
    indices = np.arange(num_envs)
    if where is None:
        return indices
    try:
        is_index = integer_of(where) is not None
        array = np.asarray([where] if is_index else where)
        mask = array.dtype == np.bool_ and array.shape == (num_envs,)
        if not mask and (array.dtype.kind not in "iu" or array.ndim != 1):
            raise IndexError
        found: IndexArray = indices[array]
    except Exception:  # the indices are out of range, or the caller's object fails
        found = indices[:0]
    if not len(found) or len(set(found.tolist())) < len(found):
        raise ConfigError(
            f"expected a Boolean mask of shape ({num_envs},), an index or different indices below "
            f"{num_envs}, got {shown(where)}"
        )
    return found


def sources_for(snapshot: Snapshot, indices: IndexArray) -> IndexArray:
    """Episode of a snapshot for each of some environments.

    Raises:
        ConfigError: If it has neither one nor as many episodes.
    """
    if len(snapshot) == 1:
        return np.zeros(len(indices), np.int64)
    if len(snapshot) != len(indices):
        raise ConfigError(
            f"the snapshot is of {len(snapshot)} environments, but {len(indices)} are to go on "
            "from it; expected as many, or one"
        )
    return np.arange(len(indices))


Which = IndexArray | slice
"""Some environments; a slice for all of them, which is faster."""


def which_of(indices: IndexArray, count: int) -> Which:
    """The indices, or a slice where they are all of so many in their order."""
    in_order = len(indices) == count and np.array_equal(indices, np.arange(count))
    return slice(None) if in_order else indices


def batch_columns(env: FMUEnv, which: Which) -> Columns:
    """Copy the quantities of some episodes of a batch, whose prototype this is."""
    require_quantities(env)
    columns = read_columns(env, partial(_rows, which))
    return columns | {"pictured": None}


def _rows(which: Which, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Values with environments on the last axis, as a new array with them on the first."""
    rows: npt.NDArray[Any] = environments_first(values)[which].copy()
    return rows


def place_batch(env: FMUEnv, columns: Columns, sources: Which, which: Which) -> None:
    """Let hooks read the columns; parameters and variables are placed elsewhere."""
    for name in READ:
        place_column(getattr(env._episode, name), columns[name], sources, which)


def place_column(row: npt.NDArray[Any], column: Any, sources: Which, which: Which) -> None:
    """Write values of a column to an array with the environments on its last axis."""
    values = np.asarray(column)[sources]
    if values.dtype == np.object_:  # None where an episode has no such parameter
        values = values.astype(row.dtype)
    row[..., which] = environments_last(values)


def require_fit(columns: Columns) -> None:
    """Refuse columns that only single environments may have.

    Raises:
        ConfigError: If the random generator is not a ``numpy.random.PCG64``.
    """
    streams = columns["streams"]
    if isinstance(streams, list) and any(isinstance(stream, dict) for stream in streams):
        raise ConfigError(
            "the snapshot has a random generator other than numpy.random.PCG64; reset the "
            "environment with a seed before"
        )
