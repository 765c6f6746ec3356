"""Actions: their checks, their conversion to inputs of the FMU, and their scaling.

The result of ``_get_inputs`` becomes one number for each input. Scaled actions lie between -1 and 1
and stand for the whole ranges of a task's actions.
"""

from __future__ import annotations

import operator
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from math import hypot, isfinite, isnan
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.spaces.graph import GraphInstance

from fmugym.environment.spaces import to_input_types
from fmugym.errors import ConfigError, FMUGymError, shown
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray

__all__ = [
    "InputWriter",
    "are_scaled",
    "array_of",
    "as_element",
    "can_be_scaled",
    "checked_actions",
    "elements_of",
    "flat_inputs",
    "is_array_space",
    "no_action",
    "scaled_space",
    "take_action",
    "unscaled",
    "written_inputs",
]


def can_be_scaled(space: spaces.Space[Any]) -> bool:
    """Whether actions have ranges other than -1 to 1, and all of them end."""
    return isinstance(space, spaces.Box) and space.is_bounded() and not _is_unit(space)


def are_scaled(own: spaces.Space[Any], space: spaces.Space[Any]) -> bool:
    """Whether the actions of an agent, from -1 to 1, stand for the ranges of a task's actions.

    Args:
        own: The action space of the agent.
        space: Space of the task.
    """
    is_unit = isinstance(own, spaces.Box) and _is_unit(own)
    return is_unit and own.shape == space.shape and can_be_scaled(space)


def _is_unit(space: spaces.Box) -> bool:
    return bool(np.all(space.low == -1.0) and np.all(space.high == 1.0))


def scaled_space(space: Any) -> spaces.Box:
    """The space of actions from -1 to 1 for a task's actions."""
    return spaces.Box(-1.0, 1.0, space.shape, np.float32)


def unscaled(actions: npt.NDArray[Any], space: Any) -> npt.NDArray[Any]:
    """Scale actions from [-1, 1] to the range of a space, shape (..., *space.shape).

    Actions outside of [-1, 1] are clipped.
    """
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    inside = np.clip(low + (high - low) * (np.asarray(actions, np.float64) + 1.0) / 2, low, high)
    found: npt.NDArray[Any] = inside.astype(space.dtype)
    return found


_ARRAY_SPACES: Final = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)


def is_array_space(space: spaces.Space[Any]) -> bool:
    """Whether elements of N environments make one array."""
    return isinstance(space, _ARRAY_SPACES)


def checked_actions(space: Any, num_envs: int, actions: Any) -> npt.NDArray[Any]:
    """Copy the actions of N environments.

    All of them are checked, also those of environments that are about to be reset: what such an
    environment does with its action does not depend on the way of calling hooks.

    Args:
        space: The action space of one environment; see ``is_array_space``.
        num_envs: N.
        actions: What the caller gave.

    Returns:
        A new array of shape (N, ...).

    Raises:
        ConfigError: If the shape or the type does not fit, an action of a ``Discrete`` is out of
            its range, or one is NaN.
    """
    array = array_of(actions)
    if array.dtype.kind not in "biuf":
        raise ConfigError(f"the actions do not make an array of numbers: {shown(actions)}")
    if array.shape != (num_envs, *space.shape):
        raise ConfigError(
            f"the actions have shape {array.shape}, expected {(num_envs, *space.shape)}"
        )
    if array.dtype.kind == "f":
        _require_numbers(array)
    if space.dtype.kind != "f":
        _require_integers(space, array)
        if array.dtype.kind == "b":
            return array.astype(space.dtype)
    return array


def array_of(value: Any) -> npt.NDArray[Any]:
    """New array of a caller's value; an empty one of objects if it makes none."""
    try:
        return np.array(value)
    except Exception:  # lists that make no array, and the user's own __array__
        return np.empty(0, object)


def _require_numbers(array: npt.NDArray[Any]) -> None:
    if np.count_nonzero(np.isnan(array)):
        index = int(np.argwhere(np.isnan(array))[0][0])
        raise ConfigError(f"the action of environment {index} is not a number: {array[index]}")


def _require_integers(space: Any, array: npt.NDArray[Any]) -> None:
    if array.dtype.kind == "f":
        raise ConfigError(f"the actions are of type {array.dtype}, expected integers")
    if isinstance(space, spaces.Discrete):
        low, high = int(space.start), int(space.start + space.n - 1)
        if low == 0 and array.dtype == np.int64 and array.view(np.uint64).max() <= high:
            return  # a negative number would be a great one
        if array.min() < low or array.max() > high:
            index = int(np.flatnonzero((array < low) | (array > high))[0])
            raise ConfigError(f"action {array[index]} of environment {index} is not in {space}")


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


def _kept(action: Any) -> Any:
    """Copy the parts of an action that its caller may change before the next step."""
    if isinstance(action, np.ndarray):
        return action.copy()
    if type(action) is dict:
        return {name: _kept(part) for name, part in action.items()}
    if type(action) in (list, tuple):
        return type(action)(map(_kept, action))
    return GraphInstance(*map(_kept, action)) if isinstance(action, GraphInstance) else action


def take_action(env: Any, action: Any) -> tuple[Any, ...]:
    """Compute the FMU's inputs from an action, and write them for the next step.

    Args:
        env: A single environment.
        action: The action.

    Returns:
        The quantities before this step, for ``Episode.take_back``.

    Raises:
        ConfigError: If it cannot be used. Then nothing has happened.
    """
    conversions, read = env._conversions, env._episode
    elements, action = conversions.elements, _no_truth(env, action)
    if elements is None or type(action) not in _INTEGERS or action not in elements:
        _require_usable(env, action)
        action = _kept(action)
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
    if type(action) is np.ndarray and action.shape == shape and action.dtype.kind in "biuf":
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


_FLOATS: Final = frozenset({float, np.float64, np.float32})


class InputWriter:
    """Checks and writes the inputs of a single environment.

    Args:
        variables: The inputs.

    Attributes:
        all_real: Whether all inputs are Reals, so that no value is rounded.
    """

    def __init__(self, variables: Sequence[Variable]) -> None:
        self._variables = variables
        self.all_real = all(variable.kind == "real" for variable in variables)
        self._is_one_real = self.all_real and len(variables) == 1
        self._are_float64 = all(variable.type in {"Real", "Float64"} for variable in variables)
        self._count = len(variables)

    def checked(self, values: Any, action: Any) -> tuple[float, ...]:
        """Check values.

        Args:
            values: What ``_get_inputs`` returned.
            action: The action, for errors.

        Returns:
            The values, rounded to the inputs' types.

        Raises:
            ConfigError: If they are not one finite number for each input.
        """
        if self._is_one_real and type(values) in _FLOATS and isfinite(values):
            return (float(values),)
        if self._are_float64 and type(values) is np.ndarray and values.dtype.char in "fd":
            inputs = tuple(values.ravel().tolist())
            if len(inputs) == self._count and isfinite(hypot(*inputs)):
                return inputs
        return self._flat(values, action)

    def _flat(self, values: Any, action: Any) -> tuple[float, ...]:
        flat = flat_inputs(values, self._variables, lambda values: _source(values, action))
        inputs = tuple(flat.tolist())
        if not all(map(isfinite, inputs)):
            pairs = zip((v.name for v in self._variables), inputs, strict=True)
            listing = ", ".join(f"{name} = {value}" for name, value in pairs)
            raise ConfigError(f"action {shown(action)} makes {listing}; every input must be finite")
        return inputs

    def write(self, inputs: tuple[float, ...], row: FloatArray) -> None:
        """Write checked inputs to the pool's array, shape (k,)."""
        if self._is_one_real:
            row[0] = inputs[0]  # takes a quarter of the time
        else:
            row[:] = inputs


def _source(values: Any, action: Any) -> str:
    """Say for an error where inputs come from."""
    if values is action:
        return f"action {shown(values)}"
    return f"what _get_inputs returned for action {shown(action)}, {shown(values)},"
