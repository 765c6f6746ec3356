"""Checks that hooks return usable kinds of values, and finite numbers.

A result of the wrong kind is a mistake in the class, and ``ConfigError`` names the hook. Numbers
that are not finite end the episode with a fault, as a failure of the FMU does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import hypot, isfinite
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.checks import check_mapping, number_of
from fmugym.errors import ConfigError, shown

__all__ = [
    "FLOAT32_LIMIT",
    "as_flag",
    "as_info",
    "as_reward",
    "finiteness_of",
    "given",
]

FLOAT32_LIMIT: Final = float(np.finfo(np.float32).max)
"""Greater numbers become infinite in a float32 observation."""

_FEW: Final = 64
"""Up to this many elements, Python's floats are faster than numpy."""

_OBSERVE: Final = "_get_observation"

Finiteness = Callable[[Any], bool]
"""Tells whether an observation is finite; raises ConfigError if it does not fit its space."""


def given(value: Any, hook: str) -> Any:
    """Return the result of a hook unless it is None.

    Raises:
        ConfigError: If the result is None.
    """
    if value is None:
        raise ConfigError(f"{hook} returned None; is its return statement missing?")
    return value


def as_flag(hook: str, value: Any) -> bool:
    """Convert a hook's result to a bool. Also accepts 0, 1 and arrays of one element.

    Raises:
        ConfigError: If it is something else.
    """
    if type(value) is np.bool_:
        return bool(value)
    flag = _single(given(value, hook))
    if issubclass(type(flag), int | float | np.bool_ | np.number):
        number = number_of(f"what {hook} returned", flag, may_be_boolean=True)
        if number in (0.0, 1.0):
            return bool(number)
    raise ConfigError(f"{hook} returned {shown(value)}, expected True or False")


def as_reward(value: Any) -> float:
    """Convert a reward to a float, finite or not. Also accepts an array of one element.

    Raises:
        ConfigError: If it is not a number.
    """
    if type(value) is np.float64 or type(value) is np.float32:
        return float(value)
    single = _single(given(value, "_reward_policy"))
    return number_of("what _reward_policy returned", single, may_be_boolean=True)


def as_info(value: Any) -> dict[str, Any]:
    """Convert the info of a hook to a new dict.

    Raises:
        ConfigError: If it is not a mapping from names.
    """
    if type(value) is dict:
        return value.copy()
    return check_mapping("what _get_info returned", given(value, "_get_info"))


def _single(value: Any) -> Any:
    """Return the element of a one-element array; return anything else unchanged."""
    is_array = issubclass(type(value), np.ndarray)  # isinstance may call the object's methods
    return value.reshape(-1)[0] if is_array and value.size == 1 else value


def finiteness_of(space: spaces.Space[Any]) -> Finiteness:
    """Make the function that checks the observations of a space.

    Returns:
        A function that takes an observation and tells whether all its numbers are finite. It
        raises ``ConfigError`` if the observation does not have the shape and kind of the space. It
        does not check bounds.
    """
    if isinstance(space, spaces.Dict):
        checked = _of_dict({name: finiteness_of(inner) for name, inner in space.spaces.items()})
        are_short = all(map(_is_short, space.spaces.values()))
        return _of_short_arrays(space, checked) if are_short else checked
    if isinstance(space, spaces.Tuple):
        return _of_tuple([finiteness_of(inner) for inner in space.spaces])
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiBinary | spaces.MultiDiscrete):
        return _of_numbers(space)
    return _of_others(space)


def _is_short(space: spaces.Space[Any]) -> bool:
    if not isinstance(space, spaces.Box) or space.dtype.kind != "f":
        return False
    return len(space.shape) == 1 and space.shape[0] <= _FEW


def _of_numbers(space: Any) -> Finiteness:
    shape, dtype = space.shape, space.dtype
    is_short, is_float = _is_short(space), dtype.kind == "f"

    def is_finite(observation: Any) -> bool:
        if type(observation) is not np.ndarray or observation.dtype is not dtype:
            observation = _numbers(observation)
            if is_float:
                with np.errstate(over="ignore", invalid="ignore"):
                    observation = observation.astype(dtype)
        if observation.shape != shape:
            raise ConfigError(
                f"{_OBSERVE} returned an array of shape {observation.shape}, but the observation "
                f"space has {shape}"
            )
        if is_short and isfinite(hypot(*observation.tolist())):
            return True
        return observation.dtype.kind != "f" or bool(np.isfinite(observation).all())

    return is_finite


def _of_dict(parts: Mapping[str, Finiteness]) -> Finiteness:
    def is_finite(observation: Any) -> bool:
        try:
            fits = observation.keys() == parts.keys()
        except Exception:  # not a mapping, or its methods fail
            fits = False
        if not fits:
            raise ConfigError(
                f"{_OBSERVE} returned {shown(observation)}, expected a dict with the keys "
                f"{', '.join(map(repr, parts))}"
            )
        return all(check(observation[name]) for name, check in parts.items())

    return is_finite


def _of_short_arrays(space: spaces.Dict, checked: Finiteness) -> Finiteness:
    """Check all arrays of a dict at once; an unusual observation is left to the other function."""
    parts = tuple((name, part.dtype, part.shape) for name, part in space.spaces.items())

    def is_finite(observation: Any) -> bool:
        if type(observation) is not dict or len(observation) != len(parts):
            return checked(observation)
        numbers: list[float] = []
        for name, dtype, shape in parts:
            array: Any = observation.get(name)
            is_array = type(array) is np.ndarray
            if not is_array or array.dtype is not dtype or array.shape != shape:
                return checked(observation)
            numbers += array.tolist()
        return isfinite(hypot(*numbers)) or checked(observation)

    return is_finite


def _of_tuple(parts: list[Finiteness]) -> Finiteness:
    def is_finite(observation: Any) -> bool:
        if not issubclass(type(observation), tuple) or len(observation) != len(parts):
            raise ConfigError(
                f"{_OBSERVE} returned {shown(observation)}, expected a tuple of {len(parts)}"
            )
        return all(check(part) for check, part in zip(parts, observation, strict=True))

    return is_finite


def _of_others(space: spaces.Space[Any]) -> Finiteness:
    def is_finite(observation: Any) -> bool:
        if not space.contains(given(observation, _OBSERVE)):
            raise ConfigError(f"{_OBSERVE} returned {shown(observation)}, which is not in {space}")
        return True

    return is_finite


def _numbers(observation: Any) -> np.ndarray[Any, Any]:
    given(observation, _OBSERVE)
    try:
        array = np.asarray(observation)
    except Exception:  # ragged lists, or objects whose methods fail
        array = np.asarray(None)
    if array.dtype.kind not in "fiub":
        raise ConfigError(f"{_OBSERVE} returned {shown(observation)}, expected an array of numbers")
    return array
