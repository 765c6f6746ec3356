"""Infos of N environments: arrays by name, each with a mask of those that they are for.

The form is that of Gymnasium's vector environments. Outside of its mask an array holds zeros, or
None where it holds objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.pool.base import FloatArray, MaskArray

__all__ = ["drawn_info", "merged", "observations_of", "restricted", "within"]


def within(mask: MaskArray, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Copy values of environments, but zero (or None) outside of a mask."""
    result = np.zeros_like(values) if values.dtype != object else np.full_like(values, None)
    result[mask] = values[mask]
    return result


def drawn_info(drawn: Mapping[str, FloatArray], mask: MaskArray) -> dict[str, Any]:
    """The info of a reset: what was drawn or overridden, by name."""
    values: dict[str, Any] = {}
    for name, row in drawn.items():
        values[name], values[f"_{name}"] = within(mask, row), mask.copy()
    return {"drawn": values, "_drawn": mask.copy()}


def restricted(infos: Mapping[str, Any], mask: MaskArray) -> dict[str, Any]:
    """The infos of some of the environments."""
    result: dict[str, Any] = {}
    for name, value in infos.items():
        is_mask = name.startswith("_") and name[1:] in infos
        if is_mask and (value & mask).any():
            inner, remaining = infos[name[1:]], value & mask
            is_dict = isinstance(inner, Mapping)
            result[name] = remaining
            result[name[1:]] = restricted(inner, mask) if is_dict else within(remaining, inner)
    return result


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Infos of different environments, in one."""
    result = dict(first)
    for name, value in second.items():
        if name not in result:
            result[name] = value
        elif isinstance(value, Mapping):
            result[name] = merged(result[name], value)
        elif name.startswith("_") and name[1:] in second:
            result[name] = result[name] | value
        else:
            mask = second[f"_{name}"]
            result[name] = result[name].copy()
            result[name][mask] = value[mask]
    return result


def observations_of(observations: Any, mask: MaskArray) -> npt.NDArray[Any]:
    """An array of objects: the observations of the environments in the mask, None for others."""
    objects = np.full(len(mask), None, dtype=object)
    for index in np.flatnonzero(mask).tolist():
        objects[index] = _one(observations, index)
    return objects


def _one(observations: Any, index: int) -> Any:
    if isinstance(observations, Mapping):
        return {name: _one(value, index) for name, value in observations.items()}
    if isinstance(observations, tuple):
        return tuple(_one(value, index) for value in observations)
    return observations[index].copy()
