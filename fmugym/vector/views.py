"""Copies of a prototype, and views of it as N environments or as one of them."""

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
from fmugym.task.values import EpisodeVariables, NamedValues
from fmugym.vector.column import PoolColumn

__all__ = ["batched", "column", "copied_attributes", "differs", "light_copy", "take"]

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


def batched(env: FMUEnv, count: int) -> None:
    """Replace the attributes that hooks read with arrays for a batch, all zero."""
    outputs = np.zeros((len(env.out), count))
    env._values = outputs
    env.state = outputs[: env._output_count]
    env.previous_state = np.zeros((env._output_count, count))
    env.inputs = np.zeros((len(env._start_inputs), count))
    space: Any = env.action_space
    env.action = np.zeros((*space.shape, count), space.dtype)
    env.previous_action = env.action.copy()
    env.step_count = np.zeros(count, np.int64)
    env.done = np.zeros(count, np.bool_)
    env.after_end = np.zeros(count, np.bool_)
    env.variables = EpisodeVariables(env.config.episode_variables)
    for name in env.variables:
        env.variables[name] = np.zeros(count)


def column(env: FMUEnv, index: int) -> FMUEnv:
    """View environment ``index`` of a batch as a single one, to read it and call its methods."""
    single = light_copy(env)
    if env._pool is not None:
        single._pool = PoolColumn(env._pool, index)
    single._values = tuple(env._values[:, index].tolist())
    single.state = single._values[: env._output_count]
    single.previous_state = tuple(env.previous_state[:, index].tolist())
    single.inputs = tuple(env.inputs[:, index].tolist())
    single.action = take(env.action, index)
    single.previous_action = take(env.previous_action, index)
    single.step_count = int(env.step_count[index])
    single.done, single.after_end = bool(env.done[index]), bool(env.after_end[index])
    parameters = {name: take(value, index) for name, value in env.parameters.items()}
    single.parameters = MappingProxyType(parameters)
    single.variables = EpisodeVariables(env.variables)
    for name, value in env.variables.items():
        single.variables[name] = take(value, index)
    for name, value in env._per_env_attributes.items():
        setattr(single, name, take(value, index))
    return single


def take(values: Any, index: int) -> Any:
    """Take one environment's part of an array that has the environments in its last axis."""
    part = np.asarray(values)[..., index]
    return part.item() if part.ndim == 0 and part.dtype.kind == "f" else part[()]


def differs(before: Any, after: Any) -> bool:
    """Whether a value has changed, if values of its type can be compared; NaNs are equal."""
    if before is after:
        return False
    if type(before) is not type(after):
        return True
    try:
        return _differ(before, after)
    except Exception:  # users' values may raise anything when compared
        return False


def _differ(before: Any, after: Any) -> bool:
    if isinstance(before, np.random.Generator):
        return bool(before.bit_generator.state != after.bit_generator.state)
    if isinstance(before, np.ndarray):
        return not np.array_equal(before, after, equal_nan=before.dtype.kind in "fc")
    if isinstance(before, list | tuple):
        return len(before) != len(after) or any(map(differs, before, after))
    if isinstance(before, dict):
        return before.keys() != after.keys() or any(differs(before[k], after[k]) for k in before)
    if not isinstance(before, bool | int | float | complex | str | np.generic):
        return False
    return bool(before != after) and not bool(before != before and after != after)
