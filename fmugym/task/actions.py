"""Conversion of actions to inputs of the FMU."""

from __future__ import annotations

import operator
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from math import hypot, isfinite, isnan
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.archive.variable import Variable
from fmugym.errors import ConfigError, FMUGymError, shown
from fmugym.task.spaces import to_input_types

__all__ = ["as_element", "elements_of", "flat_inputs", "no_action", "take_action", "written_inputs"]

_OF_MISFITS: Final = (TypeError, ValueError, LookupError, AttributeError, ArithmeticError)
"""The exceptions that indexing and arithmetic raise for values of a wrong kind or shape."""

_INTEGERS: Final = frozenset({int, np.int64})

_FEW: Final = 64
"""Up to this many elements, Python's floats are faster than numpy."""

_MANY: Final = 4096
"""Up to this many elements make a set."""


def no_action(space: spaces.Space[Any]) -> Any:
    """Return the action that hooks read before the first one; None for spaces without a zero.

    Of a ``Dict`` or a ``Tuple``, each part has its own.
    """
    if isinstance(space, spaces.Discrete):
        return space.dtype.type(space.start)
    if isinstance(space, spaces.Box | spaces.MultiBinary | spaces.MultiDiscrete):
        return np.zeros(space.shape, space.dtype)
    if isinstance(space, spaces.Dict):
        return {name: no_action(part) for name, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(map(no_action, space))
    return None


def elements_of(space: spaces.Space[Any]) -> Collection[int] | None:
    """Return the elements of a ``Discrete``; None for other spaces."""
    if not isinstance(space, spaces.Discrete):
        return None
    elements = range(int(space.start), int(space.start + space.n))
    return frozenset(elements) if len(elements) <= _MANY else elements  # a set is faster


def take_action(env: Any, action: Any) -> tuple[Any, ...]:
    """Let hooks make inputs of an action, and write them for the next step of the FMU.

    Args:
        env: A single environment.
        action: The action.

    Returns:
        What hooks have read before, for ``Episode.take_back``.

    Raises:
        ConfigError: If it cannot be used. Then nothing has happened.
    """
    conversions, read = env._conversions, env._episode
    elements, action = conversions.elements, _no_truth(env, action)
    if elements is None or type(action) not in _INTEGERS or action not in elements:
        _require_usable(env, action)
        if env._expressed and not env._own_hooks.step:
            action = as_element(env, action)[()]  # expressions read its elements
    before: tuple[Any, ...] = read.keep()
    read.action = action
    try:
        read.inputs = conversions.input_writer.checked(env._get_inputs(), action)
    except BaseException as error:  # the FMU was not touched: a better action may follow
        read.take_back(before)
        blaming = _blame(env, action, error)
        if blaming is not None:
            raise blaming from error
        raise
    conversions.input_writer.write(read.inputs, env._instance.inputs)
    return before


def written_inputs(env: Any, action: Any) -> tuple[float, ...]:
    """The FMU's inputs that an action makes; they stay in the pool, and nothing steps.

    Args:
        env: A single environment, between two steps.
        action: The action.

    Raises:
        ConfigError: If the inputs are not one finite number each.
    """
    read, writer = env._episode, env._conversions.input_writer
    before, read.action = read.keep(), action
    try:
        inputs: tuple[float, ...] = writer.checked(env._get_inputs(), action)
        writer.write(inputs, env._instance.inputs)
        return inputs
    finally:
        read.take_back(before)


def as_element(env: Any, action: Any) -> npt.NDArray[Any]:
    """The action in the shape and the type of the action space.

    Raises:
        ConfigError: If it does not fit.
    """
    space, action = env.action_space, _no_truth(env, action)
    _require_usable(env, action)
    if env._conversions.elements is not None:
        return np.array(operator.index(action), space.dtype)
    array = np.asarray(_of_shape(action, space))
    if array.dtype.kind == "f" and space.dtype.kind != "f":
        raise ConfigError(f"action {shown(action)} is not in {space}: expected integers")
    with np.errstate(over="ignore"):  # an input becomes infinite, and is refused
        return array.astype(space.dtype)


def _no_truth(env: Any, action: Any) -> Any:
    """The integer for a truth: an element of a ``Discrete`` for Gymnasium, but no index."""
    is_truth = env._conversions.elements is not None and isinstance(action, bool | np.bool_)
    return int(action) if is_truth else action


def _require_usable(env: Any, action: Any) -> None:
    """Refuse an action that is no element of a ``Discrete``, or that has a NaN."""
    elements = env._conversions.elements
    if elements is not None:
        if not _is_element(action, elements):
            raise ConfigError(f"action {shown(action)} is not in {env.action_space}")
    elif _has_nan(action):
        raise ConfigError(f"action {shown(action)} has a NaN; every number must be finite")


def _of_shape(action: Any, space: spaces.Space[Any]) -> Any:
    """The same action in the shape of its space.

    Raises:
        ConfigError: If it has another number of elements, or does not consist of numbers.
    """
    shape = space.shape or ()
    if type(action) is np.ndarray and action.shape == shape:
        return action
    try:
        array = np.asarray(action)
        if array.dtype.kind not in "biuf":
            raise ConfigError(f"action {shown(action)} does not make numbers")
        if array.shape == shape:
            return action
        return array.reshape(shape)
    except FMUGymError:
        raise
    except Exception:  # lists of different lengths, or objects whose methods fail
        raise ConfigError(
            f"action {shown(action)} is not in {space}: expected numbers of shape {shape}"
        ) from None


def _blame(env: Any, action: Any, error: BaseException) -> ConfigError | None:
    """The error if ``_get_inputs`` failed because of an action outside of the action space."""
    if isinstance(error, FMUGymError) or not isinstance(error, Exception):
        return None
    if env._own_hooks.step or not _is_misfit(action, env.action_space, error):
        return None  # with a step of its own, its actions may be others
    return ConfigError(f"action {shown(action)} is not in {env.action_space}: {shown(error)}")


def _is_element(action: Any, elements: Collection[int]) -> bool:
    """Whether an action is one of the elements of a ``Discrete``."""
    try:
        return operator.index(action) in elements
    except Exception:  # a TypeError, or whatever the object's method raises
        return False


def _has_nan(action: Any) -> bool:
    """Whether an action contains NaN, however the hooks would treat it."""
    if isinstance(action, np.ndarray):
        return action.dtype.kind == "f" and _holds_nan(action)
    if isinstance(action, float | np.floating):
        return isnan(action)
    if not isinstance(action, list | tuple | Mapping):
        return False
    try:
        return any(map(_has_nan, action.values() if isinstance(action, Mapping) else action))
    except Exception:  # a list that contains itself, or an object whose methods fail
        return False


def _is_misfit(action: Any, space: spaces.Space[Any], error: Exception) -> bool:
    """Whether a hook raised an exception because the action is not in the action space.

    Hooks may accept more than the elements of the space: a bare number for an array of one, for
    example. Only the exceptions that a misfit raises are therefore blamed on the action.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium warns if actions are not arrays
            if space.contains(action):
                return False
        is_numeric = np.asarray(action).dtype.kind in "biuf"
    except Exception:  # an object whose methods fail
        return True
    return not is_numeric or isinstance(error, _OF_MISFITS)


def _holds_nan(array: npt.NDArray[np.floating[Any]]) -> bool:
    is_short = type(array) is np.ndarray and array.ndim == 1 and len(array) <= _FEW
    if is_short and isfinite(hypot(*array.tolist())):
        return False
    return bool(np.isnan(np.asarray(array)).any())


def flat_inputs(
    values: Any, variables: Sequence[Variable], source: Callable[[Any], str]
) -> npt.NDArray[np.float64]:
    """Turn what ``_get_inputs`` returned into one number for each input.

    Args:
        values: Numbers, in any shape.
        variables: The inputs.
        source: Tells in an error where the values come from.

    Returns:
        A new array of values rounded to the inputs' types, as float64; they need not be finite.

    Raises:
        ConfigError: If the values are not numbers, not one for each input, or too large for their
            type.
    """
    if values is None:
        raise ConfigError("_get_inputs returned None, expected a number for each input")
    try:
        raw = np.asarray(values)
        flat = raw.astype(np.float64, casting="unsafe" if raw.dtype == object else "same_kind")
    except Exception:  # not numbers, too large, or objects whose methods fail
        raise ConfigError(f"{source(values)} does not make numbers") from None
    flat = flat.ravel()
    if flat.size != len(variables):
        names = ", ".join(variable.name for variable in variables)
        raise ConfigError(
            f"{source(values)} makes {flat.size} values, "
            f"expected {len(variables)}, one for each input ({names})"
        )
    return to_input_types(variables, flat)
