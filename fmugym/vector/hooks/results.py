"""What hooks return for N environments at once, checked and turned into arrays.

Each function raises a ``ConfigError`` that names the hook, the expected and the actual value, if
the hook returned something else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.errors import ConfigError, shown
from fmugym.pool.base import FloatArray, MaskArray

__all__ = ["flags", "info_arrays", "input_rows", "keep", "observations", "rewards", "variable"]

_NUMBERS: Final = "biuf"
"""The kinds of numpy's types that are numbers: Booleans, integers with and without sign, floats."""

_BOOL, _FLOAT = np.dtype(np.bool_), np.dtype(np.float64)


def _returned(hook: str, value: Any) -> Any:
    """Refuse None, which is what a hook without a return statement returns."""
    if value is None:
        raise ConfigError(f"{hook} returned None; is its return statement missing?")
    return value


def flags(hook: str, value: Any, count: int) -> MaskArray:
    """Turn the result of ``_is_done`` or ``_is_truncated`` into new Booleans of shape (N,)."""
    if type(value) is np.ndarray and value.dtype == _BOOL and value.shape == (count,):
        return value.copy()
    wanted = f"True or False, or an array of {count} of them"
    array = _numbers(hook, value, count, wanted)
    if array.dtype.kind == "f" and np.isnan(array).any():
        raise _mismatch(hook, value, wanted)
    return np.array(array, np.bool_)


def rewards(value: Any, count: int) -> FloatArray:
    """Turn the result of ``_reward_policy`` into new rewards of shape (N,), finite or not."""
    if type(value) is np.ndarray and value.dtype == _FLOAT and value.shape == (count,):
        return value.copy()
    wanted = f"a number, or an array of {count} of them"
    return np.array(_numbers("_reward_policy", value, count, wanted), np.float64)


def input_rows(value: Any, inputs: FloatArray) -> None:
    """Write the result of ``_get_inputs`` to the inputs of the FMUs, shape (k, N)."""
    _returned("_get_inputs", value)
    length, count = inputs.shape
    if type(value) is np.ndarray and value.shape == inputs.shape and value.dtype == _FLOAT:
        inputs[:] = value
        return
    rows = value if isinstance(value, list | tuple) else _rows_of(value, length)
    if len(rows) != length:
        raise ConfigError(f"_get_inputs returned {len(rows)} values, expected {length}")
    for row, part in zip(inputs, rows, strict=True):
        row[:] = _numbers("_get_inputs", part, count, f"{length} numbers, or arrays of {count}")


def _rows_of(value: Any, length: int) -> Any:
    """The rows of an array; an array for a single input may be that row itself."""
    array = value if isinstance(value, np.ndarray) else np.asarray(value)
    return array if array.ndim >= (2 if length == 1 else 1) else [array]


def _numbers(hook: str, value: Any, count: int, wanted: str) -> npt.NDArray[Any]:
    """Turn a number, or an array of N numbers, into an array of shape (N,); it may be a view."""
    _returned(hook, value)
    try:
        array = np.asarray(value)
        if array.dtype.kind not in _NUMBERS:
            raise _mismatch(hook, value, wanted)
        if array.ndim > 1 and array.size == count:
            array = array.reshape(count)
        if array.shape not in {(), (1,), (count,)}:
            raise _mismatch(hook, value, wanted)
        return np.broadcast_to(array, (count,))
    except (TypeError, ValueError, OverflowError):  # lists that make no array
        raise _mismatch(hook, value, wanted) from None


def _mismatch(hook: str, value: Any, wanted: str) -> ConfigError:
    what = shown(value)
    if isinstance(value, np.ndarray):
        what = f"an array of type {value.dtype} and shape {value.shape}"
    return ConfigError(f"{hook} returned {what}, expected {wanted}")


def observations(value: Any, space: spaces.Space[Any], count: int) -> Any:
    """Turn the result of ``_get_observation`` into new arrays with environments first, not last."""
    _returned("_get_observation", value)
    if isinstance(space, spaces.Dict):
        if not isinstance(value, Mapping) or value.keys() != space.spaces.keys():
            names = ", ".join(map(repr, space.spaces))
            found = (
                f"a dict of {shown(list(value))}" if isinstance(value, Mapping) else shown(value)
            )
            raise ConfigError(f"_get_observation returned {found}, expected a dict of {names}")
        return {name: observations(value[name], space[name], count) for name in space.spaces}
    wanted = f"an array of shape {(*_shape_of(space), count)} of numbers"
    try:
        given = np.asarray(value)
        if given.dtype.kind not in _NUMBERS or given.shape != (*_shape_of(space), count):
            raise _mismatch("_get_observation", value, wanted)
        with np.errstate(over="ignore"):
            return np.array(np.moveaxis(given, -1, 0), space.dtype, order="C")
    except (TypeError, ValueError, OverflowError):  # lists that make no array
        raise _mismatch("_get_observation", value, wanted) from None


def _shape_of(space: spaces.Space[Any]) -> tuple[int, ...]:
    return space.shape or ()


def variable(name: str, value: Any, count: int) -> npt.NDArray[Any]:
    """Copy what ``_update`` has assigned to an episode variable."""
    try:
        array = np.array(value)
        fits = array.dtype.kind in _NUMBERS and array.shape[-1:] in {(), (count,)}
    except (TypeError, ValueError):  # lists that make no array
        fits = False
    if not fits:
        what = f"the episode variable {name!r}"
        raise _mismatch("_update", value, f"{count} numbers in the last axis of {what}")
    return array


def keep(name: str, row: npt.NDArray[Any], mask: MaskArray, values: npt.NDArray[Any]) -> None:
    """Undo what ``_update`` has assigned to an episode variable of the environments in a mask."""
    try:
        row[..., mask] = values
    except (IndexError, ValueError):
        raise ConfigError(
            f"_update has given the episode variable {name!r} the shape {row.shape}, expected "
            f"{len(mask)} elements in the last axis"
        ) from None


def info_arrays(info: Any, mask: MaskArray) -> dict[str, Any]:
    """Turn the result of ``_get_info``, environments last, into infos of those in a mask."""
    _returned("_get_info", info)
    if not isinstance(info, Mapping) or not all(isinstance(name, str) for name in info):
        raise ConfigError(f"_get_info returned {shown(info)}, expected a dict with names as keys")
    values = {name: _info_array(name, value, mask) for name, value in info.items()}
    return values | {f"_{name}": mask.copy() for name in values}


def _info_array(name: str, value: Any, mask: MaskArray) -> Any:
    if isinstance(value, Mapping):
        return info_arrays(value, mask)
    count = len(mask)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        raise _info_mismatch(name, value, count) from None
    if array.ndim == 0:
        return _everywhere(value, array, count)
    if array.shape[-1] != count:
        raise _info_mismatch(name, value, count)
    return np.array(np.moveaxis(array, -1, 0), order="C")


def _everywhere(value: Any, array: npt.NDArray[Any], count: int) -> npt.NDArray[Any]:
    """The same value for all environments; text and objects stay what they are."""
    if array.dtype.kind in "bifc" or array.dtype.kind == "u":
        return np.full(count, array[()])
    objects = np.empty(count, object)
    objects[:] = [value] * count
    return objects


def _info_mismatch(name: str, value: Any, count: int) -> ConfigError:
    return ConfigError(
        f"_get_info returned {shown(value)} as {name!r}, expected one value for all environments, "
        f"or an array whose last axis has {count} elements"
    )
