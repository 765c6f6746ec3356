"""The form of infos of N environments, and the ways into it and out of it.

Infos are arrays by name with environments on the first axis, each with a mask that says which
environments it is for: ``infos["x"]`` and ``infos["_x"]``, as in Gymnasium's vector environments.
Outside of its mask an array holds zeros, or None where it holds objects. A dict in an info becomes
a dict of such arrays, with a mask of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError, shown
from fmugym.pool.base import MaskArray

__all__ = ["coded", "gathered", "handed_out", "mapped", "masked", "with_masks"]


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
