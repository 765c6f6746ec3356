"""Attributes of a class's own, which ``FMUEnv`` does not have."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Collection, Mapping
from typing import Any, Final

import numpy as np

__all__ = ["changed", "plain_attributes", "put_back", "same"]

_LARGEST: Final = 2**20
"""Arrays of more bytes are taken for data that hooks only read."""

_ATOMS: Final = (bool, int, float, complex, str, bytes, type(None), np.generic)


def plain_attributes(attributes: Mapping[str, Any], foreign: Collection[str]) -> dict[str, Any]:
    """Copy the attributes that hold plain data: numbers, texts, arrays, and lists of them.

    Args:
        attributes: The attributes of an environment.
        foreign: Those that ``FMUEnv`` keeps itself.
    """
    return {
        name: copy.deepcopy(value)
        for name, value in attributes.items()
        if name not in foreign and _is_plain(value)
    }


def put_back(env: Any, attributes: Mapping[str, Any]) -> None:
    """Give an environment the attributes that it had before, and no others."""
    now = vars(env)
    for name in now.keys() - attributes.keys():
        del now[name]
    now.update(attributes)


def changed(now: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes that are new or have another value than before."""
    return {n: v for n, v in now.items() if n not in before or not same(v, before[n])}


def same(one: Any, other: Any) -> bool:
    """Whether two plain values are equal; NaN equals NaN."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(
            one, other, equal_nan=one.dtype.kind in "fc"
        )
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple | deque):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(one == other) or (one != one and other != other)


def _is_plain(value: Any, around: tuple[Any, ...] = ()) -> bool:
    """Whether a value, which is in others, is a number, text or array, or a container of them."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biufc" and value.nbytes <= _LARGEST
    if type(value) not in (list, tuple, deque, set, dict):
        return isinstance(value, _ATOMS)
    if any(value is one for one in around):
        return False
    parts = [*value, *value.values()] if type(value) is dict else value
    return all(_is_plain(one, (*around, value)) for one in parts)
