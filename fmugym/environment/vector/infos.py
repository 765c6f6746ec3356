"""Infos and observations of N environments: the form of infos, and the ways into it and out of it.

Infos are arrays by name with environments on the first axis, each with a mask that says which
environments it is for: ``infos["x"]`` and ``infos["_x"]``, as in Gymnasium's vector environments.
Outside of its mask an array holds zeros, or None where it holds objects. A dict in an info becomes
a dict of such arrays, with a mask of its own. Names may share a mask.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import chain
from math import isfinite
from operator import getitem
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.environment.episode import environments_first
from fmugym.environment.episode_start import EpisodeStart
from fmugym.environment.value_mappings import UNFILLED, LateDict
from fmugym.errors import ConfigError, shown
from fmugym.pool.pool import FloatArray, MaskArray

__all__ = [
    "add_ends",
    "add_starts",
    "coded",
    "copy_rows",
    "gathered",
    "handed_out",
    "last_observations",
    "mapped",
    "masked",
    "merged",
    "observation_of",
    "restricted",
    "rows_not_finite",
    "with_masks",
]


def mapped(function: Callable[..., Any], *trees: Any) -> Any:
    """Apply a function to the values at the same place of dicts and tuples of values."""
    first = trees[0]
    if isinstance(first, Mapping):
        return {name: mapped(function, *(tree[name] for tree in trees)) for name in first}
    if type(first) is tuple:
        return tuple(mapped(function, *parts) for parts in zip(*trees, strict=True))
    return function(*trees)


def masked(mask: MaskArray, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Copy values of environments, but zero (or None) outside of a mask."""
    result = np.zeros_like(values) if values.dtype != object else np.full_like(values, None)
    result[mask] = values[mask]
    return result


def with_masks(values: Mapping[str, Any], mask: MaskArray) -> dict[str, Any]:
    """Make infos of arrays that are zero, or None, outside of a mask already."""
    infos: dict[str, Any] = {}
    for name, value in values.items():
        infos[name] = with_masks(value, mask) if type(value) is dict else value
        infos[f"_{name}"] = mask.copy()
    return infos


def coded(rows: Mapping[str, Any], mask: MaskArray) -> dict[str, Any]:
    """Make infos of the environments in a mask from arrays of all environments."""
    return with_masks(mapped(partial(masked, mask), rows), mask)


def gathered(infos: Mapping[int, Mapping[str, Any]], count: int) -> dict[str, Any]:
    """Make infos of N environments from infos of single ones.

    The first value of a name decides on the type: numbers make an array of numbers, arrays an array
    with one more axis, dicts a dict, and anything else an array of objects.

    Args:
        infos: The infos by the number of the environment.
        count: N.

    Raises:
        ConfigError: If a value does not fit the first one of its name.
    """
    result: dict[str, Any] = {}
    indices, rows = list(infos), list(infos.values())
    for name in dict.fromkeys(chain.from_iterable(rows)):
        own, places = [row[name] for row in rows if name in row], indices
        if len(own) < len(rows):
            places = [index for index, row in infos.items() if name in row]
        mask = np.zeros(count, np.bool_)
        mask[places] = True
        result[name], result[f"_{name}"] = _gathered_values(name, places, own, count), mask
    return result


def _gathered_values(name: str, indices: list[int], own: list[Any], count: int) -> Any:
    first = own[0]
    if isinstance(first, dict):
        for index, value in zip(indices, own, strict=True):
            if not isinstance(value, dict):
                raise _misfit(name, index, value)
        return gathered(dict(zip(indices, own, strict=True)), count)
    values = _empty_for(first, count)
    if values.dtype != object and values.ndim == 1 and set(map(type, own)) == {type(first)}:
        with suppress(OverflowError):  # an integer is too large, and the loop finds out which
            values[indices] = np.array(own, values.dtype)
            return values
    for index, value in zip(indices, own, strict=True):
        try:
            values[index] = value
        except Exception:  # users' infos may raise anything
            raise _misfit(name, index, value) from None
    return values


def _empty_for(value: Any, count: int) -> npt.NDArray[Any]:
    kind = type(value)
    if kind in (int, float, bool) or issubclass(kind, np.number):
        return np.zeros(count, kind)
    if isinstance(value, np.ndarray):
        return np.zeros((count, *value.shape), value.dtype)
    return np.full(count, None, object)


def _misfit(name: str, index: int, value: Any) -> ConfigError:
    return ConfigError(
        f"environment {index}: its info does not fit those of the others: {name!r} is "
        f"{shown(value)}"
    )


def handed_out(infos: Mapping[str, Any], into: Any) -> None:
    """Write infos to the dicts of single environments; numbers become Python's.

    Args:
        infos: The infos.
        into: The dict of each environment, by number.
    """
    for name, values in infos.items():
        mask = infos.get(f"_{name}")
        if mask is None:  # it is a mask itself
            continue
        indices = np.flatnonzero(mask).tolist()
        for index, value in zip(indices, _parts(values, indices), strict=True):
            into[index][name] = value


def _parts(values: Any, indices: list[int]) -> list[Any]:
    if isinstance(values, Mapping):
        parts: dict[int, Any] = {index: {} for index in indices}
        handed_out(values, parts)
        return list(parts.values())
    chosen = values[indices]
    return chosen.tolist() if chosen.ndim == 1 else list(chosen)


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
    infos["drawn"] = LateDict({UNFILLED: (_told, draws, drawn, mask)})
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
        ended: Which episodes have ended, shape (N,). No caller changes it.
    """
    infos["final_obs"], infos["_final_obs"] = observations, ended
    infos["final_info"], infos["_final_info"] = told, ended


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
