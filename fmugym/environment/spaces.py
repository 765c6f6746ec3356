"""Spaces made from the FMU's variables, and conversions between elements and FMU values.

======================================  ==========================================================
variables                               space
======================================  ==========================================================
one Enumeration or one bounded Integer  ``Discrete``; element i is the i-th value in rising order
Booleans only                           ``MultiBinary``
anything else                           flat ``Box`` of float32; Booleans are 0 or 1 in it
======================================  ==========================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.environment.interface import Interface
from fmugym.errors import ConfigError, SimulationError
from fmugym.fmi.variable import LARGEST_EXACT_INTEGER, Variable, checked_value

__all__ = [
    "action_space",
    "check_choices",
    "default_observation",
    "discrete_values",
    "observation_space",
    "outputs_observation",
    "to_input_types",
]


def action_space(interface: Interface) -> spaces.Space[Any]:
    """Make the action space of the inputs that no expression writes.

    Raises:
        ConfigError: If there is no input, or an input has no limits. The text says how to set
            them.
    """
    if not interface.inputs:
        raise ConfigError(
            "there are no inputs in 'model_input_names' to make an action space from; "
            "name some, or override _get_action_space"
        )
    if not interface.chosen_inputs:
        raise ConfigError(
            "expressions write all inputs, so that there are none to make an action space from; "
            "override _get_action_space"
        )
    for variable in interface.chosen_inputs:
        if variable.kind in {"real", "integer"} and not _bounded(variable):
            raise ConfigError(
                f"input {variable.name!r} has no min and max in the FMU: give "
                f"'bounds': {{{variable.name!r}: (low, high)}} in the config, or override "
                "_get_action_space"
            )
    return _space(interface.chosen_inputs)


def check_choices(variables: Sequence[Variable], space: spaces.Space[Any]) -> None:
    """Check that each choice of a class's own action space is an item of its Enumeration.

    Args:
        variables: The inputs, which get the elements of the action as they are.
        space: The action space.

    Raises:
        ConfigError: If one is none; the input would get the nearest item instead.
    """
    match space:
        case spaces.Discrete():
            first, counts = [int(space.start)], [int(space.n)]
        case spaces.MultiDiscrete() | spaces.MultiBinary():
            counts = np.ravel(getattr(space, "nvec", np.full(space.shape or (), 2))).tolist()
            first = np.ravel(getattr(space, "start", np.zeros_like(counts))).tolist()
        case _:  # a continuous value is rounded
            return
    for variable, low, count in zip(variables, first, counts, strict=False):
        for value in range(low, low + count) if variable.items else ():
            checked_value(variable, value)


def observation_space(interface: Interface) -> spaces.Space[Any]:
    """Make the observation space of an environment's outputs. Reals may be unbounded.

    Expressions that are observed have no limits, unless they are outputs by their names.
    """
    if not interface.config.observations:
        return _space(interface.outputs)
    known = {v.name: _range_of(v) for v in interface.outputs + interface.monitors}
    unlimited = -math.inf, math.inf
    texts = [one.text.strip() for one in interface.config.observations]
    with np.errstate(over="ignore"):  # beyond float32 there is no limit
        limits = np.array([known.get(text, unlimited) for text in texts], dtype=np.float32)
    return spaces.Box(limits[:, 0], limits[:, 1], dtype=np.float32)


def discrete_values(variables: Sequence[Variable]) -> Sequence[int] | None:
    """The values that the elements of a ``Discrete`` stand for.

    Returns:
        The values in rising order, or None if the variables do not make a ``Discrete``.
    """
    if len(variables) != 1:
        return None
    (variable,) = variables
    if variable.kind == "enumeration" and variable.items:
        return sorted(value for _, value in variable.items)
    if variable.kind in {"integer", "enumeration"} and _countable(variable):
        return _integers(variable, *_range_of(variable))
    return None


def _integers(variable: Variable, low: float, high: float) -> range:
    values = range(math.ceil(low), math.floor(high) + 1)  # not a list: it may be long
    if not values:
        raise ConfigError(
            f"{variable.name!r} has no integer from {low} to {high}; give it 'bounds'"
        )
    return values


def _space(variables: tuple[Variable, ...]) -> spaces.Space[Any]:
    values = discrete_values(variables)
    if values is not None:
        return spaces.Discrete(len(values))
    if all(variable.kind == "boolean" for variable in variables):
        return spaces.MultiBinary(len(variables))
    with np.errstate(over="ignore"):  # beyond float32 there is no limit
        limits = np.array([_range_of(v) for v in variables], dtype=np.float32)
    return spaces.Box(limits[:, 0], limits[:, 1], dtype=np.float32)


def _range_of(variable: Variable) -> tuple[float, float]:
    low, high = variable.extremes
    if not low <= high:
        raise ConfigError(
            f"{variable.name!r} has min = {low} and max = {high} in the FMU; give it 'bounds', "
            "or 'min' and 'max' in a task file"
        )
    return low, high


def _bounded(variable: Variable) -> bool:
    return all(map(math.isfinite, _range_of(variable)))


def _countable(variable: Variable) -> bool:
    """Whether a ``Discrete`` can have an element for each integer within the limits."""
    return all(abs(limit) <= LARGEST_EXACT_INTEGER for limit in _range_of(variable))


def to_input_types(
    variables: Sequence[Variable], values: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Round values to their inputs' types: Booleans from 0.5 up, others to the nearest value.

    Args:
        variables: The inputs.
        values: One number for each, finite or not.

    Returns:
        The values for the FMU, still as float64.

    Raises:
        ConfigError: If a value is outside its type's range.
    """
    result = values.copy()
    for index, variable in enumerate(variables):
        if math.isfinite(values[index]) and variable.type not in {"Real", "Float64"}:
            result[index] = _to_input_type(variable, float(values[index]))
    return result


def _to_input_type(variable: Variable, value: float) -> float:
    if variable.kind == "boolean":
        return float(value >= 0.5)
    if variable.kind in {"integer", "enumeration"}:
        value = round(value)
    items = [item for _, item in variable.items]
    if items and min(items) <= value <= max(items):  # the items may have gaps between them
        value = min(items, key=lambda item: abs(item - value))
    return checked_value(variable, value)


def default_observation(
    interface: Interface, space: spaces.Space[Any]
) -> Callable[[Sequence[float]], Any]:
    """Make the function that turns the outputs into an element of an observation space.

    Args:
        interface: Names the outputs.
        space: A ``Box`` or ``MultiBinary`` with one element for each output, or a ``Discrete``
            for a single one.

    Returns:
        The function; it returns a new array each time.

    Raises:
        ConfigError: If the space does not fit the outputs.
    """
    if isinstance(space, spaces.Discrete):
        return _discrete_observation(interface, space)
    count = len(interface.outputs)
    if not isinstance(space, spaces.Box | spaces.MultiBinary) or space.shape != (count,):
        raise ConfigError(
            f"the {count} outputs do not make an element of {space}; override _get_observation"
        )
    dtype = space.dtype
    return lambda state: np.array(state, dtype=dtype)


def outputs_observation(
    interface: Interface, space: spaces.Space[Any]
) -> Callable[[Sequence[float]], Any]:
    """Make the function behind ``super()._get_observation()`` for a class that overrides it.

    Args:
        interface: Names the outputs.
        space: The environment's observation space, which the outputs alone may not fit.

    Returns:
        A function that returns elements of the space or, if the outputs do not fit it, of their
        default space. If they have no default space, calling it raises ``ConfigError``.
    """

    @cache
    def make() -> Callable[[Sequence[float]], Any]:
        try:
            return default_observation(interface, space)
        except ConfigError:
            return default_observation(interface, observation_space(interface))

    return lambda state: make()(state)


def _places(values: Sequence[int], numbers: Any) -> tuple[Any, Any]:
    """Find numbers among rising values; returns their places, and whether they are there."""
    if isinstance(values, range):  # which may be too long for an array
        return numbers.astype(np.int64) - values[0], (numbers >= values[0]) & (
            numbers <= values[-1]
        )
    table = np.array(values)
    places = np.searchsorted(table, numbers)
    return places, table[np.minimum(places, len(table) - 1)] == numbers


def _discrete_observation(
    interface: Interface, space: spaces.Discrete
) -> Callable[[Sequence[Any]], Any]:
    """Make the function for one output, which is a number or an array."""
    if len(interface.outputs) != 1:
        raise ConfigError(
            f"{len(interface.outputs)} outputs do not make an element of {space}; "
            "override _get_observation"
        )
    values = discrete_values(interface.outputs)
    if values is None or space.n != len(values):
        return lambda state: np.asarray(state[0]).astype(np.int64)[()]
    (variable,) = interface.outputs
    start = int(space.start)

    def observe(state: Sequence[Any]) -> Any:
        numbers = np.asarray(state[0])
        places, is_known = _places(values, numbers)
        if not is_known.all():
            raise SimulationError(
                f"output {variable.name!r} is {numbers[~is_known].flat[0]:g}, which is not one of "
                "its declared values"
            )
        return places + start

    return observe
