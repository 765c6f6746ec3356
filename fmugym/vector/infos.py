"""Infos and observations of N environments; ``fmugym.vector.info_arrays`` has the form of infos."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from operator import getitem
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.pool.base import FloatArray, MaskArray
from fmugym.task.episode import environments_first
from fmugym.task.episode_start import EpisodeStart
from fmugym.task.values import LateDict
from fmugym.vector.info_arrays import coded, mapped, masked

__all__ = [
    "add_ends",
    "add_starts",
    "copy_rows",
    "last_observations",
    "merged",
    "observation_of",
    "restricted",
    "rows_not_finite",
]


def add_starts(
    infos: dict[str, Any], draws: EpisodeStart, drawn: FloatArray, mask: MaskArray
) -> None:
    """Add what infos tell of episodes that have started.

    Args:
        infos: The infos.
        draws: What the environments in the mask have drawn from.
        drawn: What they have drawn, shape (draws, N), which is rarely read.
        mask: The environments. No caller changes it.
    """
    infos["drawn"] = LateDict.of(_told, draws, drawn, mask)
    infos["_drawn"] = mask


def _told(draws: EpisodeStart, drawn: FloatArray, mask: MaskArray) -> dict[str, Any]:
    told = draws.told | draws.shown(drawn)
    kinds = {name: object if name in draws.strings else None for name in told}
    return coded({n: _of_each(v, len(mask), kinds[n]) for n, v in told.items()}, mask)


def _of_each(value: Any, count: int, kind: Any) -> Any:
    is_drawn = isinstance(value, np.ndarray)
    return environments_first(value) if is_drawn else np.full(count, value, kind)


def add_ends(
    infos: dict[str, Any], observations: Any, told: Mapping[str, Any], ended: MaskArray
) -> None:
    """Add what infos of the mode ``SAME_STEP`` tell of episodes that have ended.

    Args:
        infos: The infos.
        observations: The last observations.
        told: The last infos.
        ended: Which episodes have ended, shape (N,); the infos keep this array.
    """
    infos["final_obs"], infos["final_info"] = observations, told
    infos["_final_obs"] = infos["_final_info"] = ended


def restricted(infos: Mapping[str, Any], mask: MaskArray) -> dict[str, Any]:
    """The infos of some of the environments."""
    result: dict[str, Any] = {}
    for name, values in infos.items():
        own = infos.get(f"_{name}")
        if own is None or not (own & mask).any():  # it is a mask itself, or of others
            continue
        is_dict = isinstance(values, Mapping)
        result[name] = restricted(values, mask) if is_dict else masked(own & mask, values)
        result[f"_{name}"] = own & mask
    return result


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Infos of different environments, in one."""
    result = dict(first)
    for name, values in second.items():
        mask = second.get(f"_{name}")
        if name not in result:
            result[name] = values
        elif isinstance(values, Mapping):
            result[name] = merged(result[name], values)
        elif mask is None:  # it is a mask itself
            result[name] = result[name] | values
        else:
            result[name] = result[name].copy()
            result[name][mask] = values[mask]
    return result


def copy_rows(source: Any, target: Any, mask: MaskArray) -> None:
    """Copy the rows of environments in a mask from arrays, or dicts of arrays, to others."""

    def copy(values: npt.NDArray[Any], others: npt.NDArray[Any]) -> None:
        values[mask] = others[mask]

    mapped(copy, target, source)


def rows_not_finite(values: Any) -> MaskArray | None:
    """Mask of rows with NaN or infinity in an array or a dict of arrays; None for no row."""
    if type(values) is dict:
        found = [rows for rows in map(rows_not_finite, values.values()) if rows is not None]
        return np.logical_or.reduce(found) if found else None
    if values.dtype.kind != "f":
        return None
    if isfinite(np.vdot(values, values)):  # two thirds of the time of what follows
        return None
    finite = np.isfinite(values)
    if np.count_nonzero(finite) == finite.size:  # a third of the time of finite.all()
        return None
    rows: MaskArray = ~finite.reshape(len(finite), -1).all(axis=1)
    return rows


def observation_of(observations: Any, index: int) -> Any:
    """A copy of the observation of one environment."""
    return mapped(lambda values: values[index].copy(), observations)


def last_observations(space: spaces.Space[Any], observations: Any, mask: MaskArray) -> Any:
    """The observations of the environments in a mask, in the form of ``final_obs``.

    Args:
        space: That of one environment.
        observations: Those of all.
        mask: The environments, shape (N,).

    Returns:
        A new array of the same shape and type, in which floats of other environments are NaN; a
        dict of such arrays for a ``Dict``; an array of objects, None for others, for what makes no
        arrays, such as a ``Tuple``.
    """
    if isinstance(space, spaces.Dict):
        parts = space.spaces.items()
        return {name: last_observations(part, observations[name], mask) for name, part in parts}
    if not isinstance(observations, np.ndarray):
        objects = np.full(len(mask), None, dtype=object)
        for index in np.flatnonzero(mask).tolist():
            is_tuple = isinstance(space, spaces.Tuple)
            objects[index] = (observation_of if is_tuple else getitem)(observations, index)
        return objects
    last = np.empty_like(observations)
    last.fill(np.nan if observations.dtype.kind == "f" else 0)
    ended = mask.nonzero()[0]  # a third of the time of the mask
    last[ended] = observations[ended]
    return last
