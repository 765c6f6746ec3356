"""Results of hooks for N environments at once: calls on arrays, checked and turned into arrays.

Expressions may stand in the place of hooks. Each function that checks a result raises a
``ConfigError`` that names the hook, the expected and the actual value, if the hook returned
something else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import check_mapping, items_of, number_of
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import environments_first
from fmugym.environment.episode_start import EpisodeStart
from fmugym.environment.hook_results import given
from fmugym.environment.spaces import to_input_types
from fmugym.environment.vector.infos import coded, observation_of, rows_not_finite
from fmugym.errors import ConfigError, FMUGymError, SimulationError, shown
from fmugym.pool.pool import FloatArray, MaskArray

__all__ = [
    "flags",
    "info_arrays",
    "infos_of_hooks",
    "observations",
    "observations_of_hooks",
    "require_finite_start",
    "require_possible_inputs",
    "restore_variable",
    "rewards",
    "type_of_variable",
    "variable",
    "write_inputs",
    "write_inputs_of_hooks",
]

_NUMBERS: Final = "biuf"
"""The kinds of numpy's types that are numbers: Booleans, integers with and without sign, floats."""

_BOOL, _FLOAT = np.dtype(np.bool_), np.dtype(np.float64)


def flags(hook: str, value: Any, count: int) -> MaskArray:
    """Turn the result of ``_is_done`` or ``_is_truncated`` into new Booleans of shape (N,)."""
    if type(value) is np.ndarray and value.dtype == _BOOL and value.shape == (count,):
        return value.copy()
    wanted = f"True or False, or an array of {count} of them"
    array = _numbers(hook, value, count, wanted)
    if array.dtype.kind != "b" and not np.isin(array, (0, 1)).all():
        raise _mismatch(hook, value, wanted)
    return np.array(array, np.bool_)


def rewards(value: Any, count: int) -> FloatArray:
    """Turn the result of ``_reward_policy`` into new rewards of shape (N,), finite or not."""
    if type(value) is np.ndarray and value.shape == (count,) and value.dtype.kind in _NUMBERS:
        return value.astype(np.float64)
    wanted = f"a number, or an array of {count} of them"
    return np.array(_numbers("_reward_policy", value, count, wanted), np.float64)


def write_inputs(value: Any, inputs: FloatArray) -> None:
    """Write the result of ``_get_inputs`` to the inputs of the FMUs, shape (k, N)."""
    length, count = inputs.shape
    is_array = type(value) is np.ndarray and value.dtype.kind in _NUMBERS
    if is_array and (value.shape == inputs.shape or (length == 1 and value.shape == (count,))):
        inputs[:] = value
        return
    given(value, "_get_inputs")
    wanted = f"{length} numbers, or arrays of {count}"
    is_list = issubclass(type(value), list | tuple)
    rows = items_of(value) if is_list else _rows_of(value, length, wanted)
    if len(rows) != length:
        raise ConfigError(f"_get_inputs returned {len(rows)} values, expected {length}")
    for row, part in zip(inputs, rows, strict=True):
        is_row = type(part) is np.ndarray and part.shape == (count,)
        is_ready = is_row and part.dtype.kind in _NUMBERS
        row[:] = part if is_ready else _numbers("_get_inputs", part, count, wanted)


def _rows_of(value: Any, length: int, wanted: str) -> Any:
    """The rows of an array; an array for a single input may be that row itself."""
    array = value
    if type(value) is not np.ndarray:
        with _expected("_get_inputs", value, wanted):
            array = np.asarray(value)
    return array if array.ndim >= (2 if length == 1 else 1) else [array]


def _numbers(hook: str, value: Any, count: int, wanted: str) -> npt.NDArray[Any]:
    """Turn a number, or an array of N numbers, into an array of shape (N,); it may be a view."""
    given(value, hook)
    with _expected(hook, value, wanted):
        array = np.asarray(value)
        if array.dtype == object:  # decimals, fractions and the like
            numbers = [number_of(hook, one, may_be_boolean=True) for one in array.flat]
            array = np.array(numbers).reshape(array.shape)
        if array.ndim > 1 and array.size == count:
            array = array.reshape(count)
        if array.dtype.kind in _NUMBERS:
            return np.broadcast_to(array, (count,))
        raise _mismatch(hook, value, wanted)


@contextmanager
def _expected(hook: str, value: Any, wanted: str) -> Iterator[None]:
    """Refuse a value that makes no array, or whose own methods fail."""
    try:
        yield
    except FMUGymError:
        raise
    except Exception:
        raise _mismatch(hook, value, wanted) from None


def _mismatch(hook: str, value: Any, wanted: str) -> ConfigError:
    what = shown(value)
    if type(value) is np.ndarray:
        what = f"an array of type {value.dtype} and shape {value.shape}"
    return ConfigError(f"{hook} returned {what}, expected {wanted}")


def observations(value: Any, space: spaces.Space[Any], count: int) -> Any:
    """Turn the result of ``_get_observation`` into new arrays with environments first, not last."""
    hook, is_dict = "_get_observation", isinstance(space, spaces.Dict)
    is_array = type(value) is np.ndarray and not is_dict and value.dtype == space.dtype
    if is_array and value.shape == (*_shape_of(space), count):
        return np.array(environments_first(value), order="C")
    given(value, hook)
    if isinstance(space, spaces.Dict):
        if type(value) is dict and value.keys() == space.spaces.keys():
            parts = space.spaces.items()
            return {name: observations(value[name], part, count) for name, part in parts}
        wanted = "a dict of " + ", ".join(map(repr, space.spaces))
        with _expected(hook, value, wanted):
            if not isinstance(value, Mapping) or value.keys() != space.spaces.keys():
                raise _mismatch(hook, value, wanted)
            return {name: observations(value[name], space[name], count) for name in space.spaces}
    wanted = f"an array of numbers of shape {(*_shape_of(space), count)}"
    with _expected(hook, value, wanted):
        array = np.asarray(value)
        if array.dtype.kind not in _NUMBERS or array.shape != (*_shape_of(space), count):
            raise _mismatch(hook, value, wanted)
        with np.errstate(over="ignore", invalid="ignore"):  # infinite is a fault, and found later
            return np.array(environments_first(array), space.dtype, order="C")


def _shape_of(space: spaces.Space[Any]) -> tuple[int, ...]:
    return space.shape or ()


def variable(name: str, value: Any, count: int) -> npt.NDArray[Any]:
    """Copy the value of an episode variable from a hook; its last axis becomes (N,)."""
    try:
        array = np.array(value)
        fits = array.dtype.kind in _NUMBERS and array.shape[-1:] in {(), (count,)}
    except Exception:  # lists that make no array, or objects whose own methods fail
        fits = False
    if not fits:
        raise ConfigError(
            f"a hook has set the episode variable {name!r} to {shown(value)}, expected a number, "
            f"or {count} numbers in the last axis"
        )
    return array if array.ndim else np.full(count, array)


def type_of_variable(draws: EpisodeStart, name: str, assigned: np.dtype[Any]) -> np.dtype[Any]:
    """The type in which N environments keep an episode variable.

    It is the type that ``_update`` assigns if this can hold the value with which episodes start.
    Otherwise it is float64, because episodes start while others are under way.

    Args:
        draws: What episodes start with.
        name: The variable.
        assigned: The type of what ``_update`` has assigned.
    """
    if name in draws.drawn_names:
        return _FLOAT
    start = np.asarray(draws.constant_variables[name], _FLOAT)
    with np.errstate(all="ignore"):
        fits = start.astype(assigned).astype(_FLOAT).tobytes() == start.tobytes()
    return assigned if fits else _FLOAT


def restore_variable(
    name: str, row: npt.NDArray[Any], mask: MaskArray, before: npt.NDArray[Any]
) -> None:
    """Undo the assignment of ``_update`` to an episode variable of environments in a mask."""
    try:
        np.copyto(row, before, where=mask, casting="unsafe")  # half the time of an assignment
    except ValueError:
        raise ConfigError(
            f"a hook has given the episode variable {name!r} the shape {row.shape}, where it had "
            f"{before.shape}"
        ) from None


def info_arrays(info: Any, mask: MaskArray) -> dict[str, Any]:
    """Turn the result of ``_get_info``, environments last, into infos of those in a mask."""
    return coded(_info_rows(info, len(mask)), mask)


def _info_rows(info: Any, count: int) -> dict[str, Any]:
    given(info, "_get_info")
    named = check_mapping("what _get_info returned", info)
    return {name: _info_row(name, value, count) for name, value in named.items()}


def _info_row(name: str, value: Any, count: int) -> Any:
    wanted = f"as {name!r} one value, or an array with {count} elements in the last axis"
    with _expected("_get_info", value, wanted):
        if isinstance(value, Mapping):
            return _info_rows(value, count)
        array = np.asarray(value)
        if array.ndim and array.shape[-1] != count:
            raise _mismatch("_get_info", value, wanted)
        return environments_first(array) if array.ndim else _everywhere(value, array, count)


def _everywhere(value: Any, array: npt.NDArray[Any], count: int) -> npt.NDArray[Any]:
    """The same value for all environments; text and objects stay the same."""
    if array.dtype.kind in "biufc":
        return np.full(count, array[()])
    objects = np.empty(count, object)
    objects[:] = [value] * count
    return objects


def observations_of_hooks(env: FMUEnv) -> Any:
    """The observations of all environments, whose prototype this is.

    Raises:
        ConfigError: If the hook returns something unusable.
    """
    count = env._instance.pool.num_instances
    return observations(env._get_observation(), env.observation_space, count)


def infos_of_hooks(env: FMUEnv, mask: MaskArray) -> dict[str, Any]:
    """The infos of the hook and of the pool, of the environments in the mask.

    Raises:
        ConfigError: If the hook returns something unusable.
    """
    if not env._conversions.has_info:
        return {}
    infos = info_arrays(env._get_info(), mask)
    if env._instance.tells:
        infos |= info_arrays(env._instance.pool.info(), mask)
    return infos


def require_finite_start(observations: Any, mask: MaskArray) -> None:
    """Refuse first observations that are not finite.

    Raises:
        SimulationError: If there is one in the mask.
    """
    wrong = rows_not_finite(observations)
    if wrong is not None and (wrong & mask).any():
        index = int(np.flatnonzero(wrong & mask)[0])
        first = shown(observation_of(observations, index))
        raise SimulationError(f"environment {index}: the first observation is not finite: {first}")


def write_inputs_of_hooks(env: FMUEnv, inputs: FloatArray, idle: MaskArray | None) -> None:
    """Write the inputs that the hook returns, in the types of the FMU's variables.

    Args:
        env: The prototype.
        inputs: Where they go, shape (m, N).
        idle: Which environments do not step, shape (N,); None if all do.

    Raises:
        ConfigError: If an environment that steps has an input that is not finite or does not fit
            its type.
    """
    write_inputs(env._get_inputs(), inputs)
    if not env._conversions.input_writer.all_real:
        for index in _stepping(inputs, idle):
            inputs[:, index] = to_input_types(env.interface.inputs, inputs[:, index])
    _require_finite(inputs, idle)


def require_possible_inputs(env: FMUEnv, idle: MaskArray | None) -> None:
    """Refuse inputs that are not finite, which they also are outside of their type's range.

    Args:
        env: The prototype.
        idle: Which environments do not step, shape (N,); None if all do.

    Raises:
        ConfigError: If there is such an input.
    """
    inputs = env._instance.pool.inputs
    if not env._conversions.input_writer.all_real and not np.isfinite(inputs).all():
        write_inputs_of_hooks(env, np.array(inputs), idle)
    _require_finite(inputs, idle)


def _stepping(inputs: FloatArray, idle: MaskArray | None) -> list[int]:
    """The indices of the environments that step."""
    return [i for i in range(inputs.shape[1]) if idle is None or not idle[i]]


def _require_finite(inputs: FloatArray, idle: MaskArray | None) -> None:
    if isfinite(np.vdot(inputs, inputs)):  # half the time of what follows
        return
    finite = np.isfinite(inputs)
    for index in _stepping(inputs, idle):
        if not finite[:, index].all():
            raise ConfigError(f"an input of environment {index} is not finite: {inputs[:, index]}")
