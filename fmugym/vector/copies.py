"""Copies of a prototype."""

from __future__ import annotations

import copy
import logging
from types import MappingProxyType, MethodType
from typing import Any

import numpy as np
from gymnasium import spaces

from fmugym.archive.fmu import FMU
from fmugym.config import EnvConfig
from fmugym.env import FMUEnv
from fmugym.pool import PoolSpec
from fmugym.task.episode import EpisodePlan
from fmugym.task.interface import Interface
from fmugym.task.values import NamedValues

__all__ = ["copied_attributes", "light_copy"]

_SHARED_TYPES = (
    *(bool, int, float, complex, str, bytes, type(None), np.generic),
    *(MappingProxyType, logging.Logger, spaces.Space),
    *(FMU, EnvConfig, Interface, PoolSpec, EpisodePlan, NamedValues),
)
"""Types of attributes that do not change, or are too costly to copy."""

_SHARED_NAMES = frozenset(
    {"_constructor_arguments", "metadata", "_start_inputs", "_no_action", "_pool"}
    | {"_input_row", "_output_row", "_observation_row", "_renderer"}
)
"""Attributes of ``FMUEnv`` that hooks do not read."""


def light_copy(env: FMUEnv) -> FMUEnv:
    """Copy an environment without loading the FMU again; the copy shares all attributes."""
    copied = type(env).__new__(type(env))
    copied.__dict__.update(env.__dict__)
    for name, value in env.__dict__.items():
        if isinstance(value, MethodType) and value.__self__ is env:
            copied.__dict__[name] = MethodType(value.__func__, copied)
    copied.out = NamedValues("output", list(env.out), lambda: copied._values)
    return copied


def copied_attributes(env: FMUEnv) -> dict[str, Any]:
    """Copy the attributes that hooks might change; return the copies by name."""
    memo = {id(env): env, id(env.spec): env.spec}
    return {
        name: _copied(value, memo)
        for name, value in env.__dict__.items()
        if name not in _SHARED_NAMES and _may_change(value)
    }


def _may_change(value: Any) -> bool:
    if isinstance(value, _SHARED_TYPES) or callable(value):
        return False
    return not (type(value) is tuple and all(type(element) is float for element in value))


def _copied(value: Any, memo: dict[int, Any]) -> Any:
    try:
        return copy.deepcopy(value, memo.copy())
    except Exception:  # a user's object that cannot be copied: share it
        return value
