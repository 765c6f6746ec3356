"""The values with which episodes start: which variables may have some, and which ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import ModelDescription
from fmugym.archive.variable import Variable, checked_value, unknown_rest
from fmugym.checks import parts_of_array
from fmugym.distributions import Choice, as_distribution, is_distribution
from fmugym.errors import ConfigError, shown
from fmugym.task.variable_roles import require_not_driven, require_numeric

__all__ = [
    "check_rest_is_known",
    "checked",
    "checked_column",
    "spread",
    "start_time_of",
    "start_values",
    "start_variable",
    "structural_values",
    "texts_in",
]


def start_values(
    description: ModelDescription, given: Mapping[str, Any]
) -> list[tuple[Variable, Any]]:
    """Check start values by name: numbers, distributions, texts, and lists of them for arrays.

    Returns:
        The scalars and what each starts with; an element that is named itself comes in its place in
        the array, and counts more than what is given for the array.

    Raises:
        ConfigError: If a name is unknown, or its variable cannot start with the value.
    """
    found: dict[str, tuple[Variable, Any]] = {}
    elements = {}
    for name, value in given.items():
        scalars = description.scalars(name)
        for variable, own in zip(scalars, spread(name, scalars, value), strict=True):
            _check_start(description, variable, own)
            pair = variable, checked(variable, own)
            found.setdefault(variable.name, pair)
            if variable.name == name:
                elements[name] = pair
    check_rest_is_known([variable for variable, _ in found.values()])
    return [elements.get(name, pair) for name, pair in found.items()]


def check_rest_is_known(variables: Sequence[Variable]) -> None:
    """Check the elements of arrays that are not written, which keep their start values.

    Raises:
        ConfigError: If nobody knows these, because the array has a size of its own.
    """
    found = unknown_rest(variables)
    if found is not None:
        missing, array = found
        raise ConfigError(
            f"there is no value of {missing.name!r}: {array.name!r} has a size of its own, "
            f"{array.shape}, for which the FMU has no start values; give all elements"
        )


def structural_values(description: ModelDescription, given: Mapping[str, Any]) -> dict[str, Any]:
    """Values of structural parameters, by which arrays get their sizes.

    Raises:
        ConfigError: If one is a distribution: the sizes of spaces do not change.
    """
    known = {name: description.find(name) for name in given}
    found = {n: given[n] for n, v in known.items() if v is not None and v.is_structural}
    for name, value in found.items():
        if is_distribution(value):
            raise ConfigError(
                f"{name!r} is a structural parameter: it cannot be drawn, since spaces keep their "
                f"sizes; expected an integer, got {shown(value)}"
            )
    return found


def spread(name: str, scalars: Sequence[Variable], value: Any) -> list[Any]:
    """Give each of the scalars that a name stands for its part of a value.

    Args:
        name: The name.
        scalars: The variables.
        value: For an array nested lists of its shape, a flat list in row-major order, or one value
            for all elements, a distribution from which each is drawn for itself.

    Raises:
        ConfigError: If the shape of the value is not that of the array.
    """
    array = scalars[0].array if scalars else None
    is_array = len(scalars) != 1 or (array is not None and array.name == name)
    if not is_array:
        return [value]
    shape = (len(scalars),) if array is None else array.shape
    return [as_distribution(repr(name), part) for part in parts_of_array(name, shape, value)]


def start_variable(description: ModelDescription, name: str, value: Any) -> Variable:
    """Find a variable that can be set before initialization.

    Raises:
        ConfigError: If no variable has this name, it cannot be set, or a float cannot hold its
            value.
    """
    variable = description.variable(name)
    _check_start(description, variable, value)
    return variable


def _check_start(description: ModelDescription, variable: Variable, value: Any) -> None:
    name = variable.name
    if variable.ticking:
        raise ConfigError(f"{name!r} cannot be set at the start: it is a clock")
    if variable.is_structural:
        raise ConfigError(
            f"{name!r} cannot be set here: it is a structural parameter, which is set under "
            "'model_parameters' of the config"
        )
    if not variable.settable_at_start:
        require_not_driven(description, variable, "be set")
        raise ConfigError(
            f"{name!r} cannot be set: it is a {variable.variability} {variable.causality} "
            f"with initial={variable.initial!r}"
        )
    if variable.is_text:
        for text in texts_in(variable, value):
            _require_text(name, text)
    else:
        require_numeric(variable, "given a start value")


def texts_in(variable: Variable, value: Any) -> Sequence[str]:
    """Texts that a String may get: the given one, or all of a distribution.

    Raises:
        ConfigError: If the distribution does not tell them.
    """
    if not is_distribution(value):
        return (value,)
    texts = getattr(value, "values", None)
    if not isinstance(texts, Sequence) or isinstance(texts, str) or not texts:
        raise ConfigError(
            f"{variable.name!r} is a String, which is drawn from a Choice of texts, or from an "
            f"object with a list of its texts as 'values', got {shown(value)}"
        )
    return texts


def _require_text(name: str, value: Any) -> None:
    if not isinstance(value, str):
        raise ConfigError(f"{name!r} is a String, got {shown(value)}")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"{name!r} cannot be {shown(value)}: UTF-8 cannot encode it") from None
    if "\0" in value:
        raise ConfigError(f"{name!r} cannot be {shown(value)}: it holds a NUL character")


def checked(variable: Variable, value: Any) -> Any:
    """Check a start value; other distributions than choices are checked when they are drawn."""
    if is_distribution(value):
        if isinstance(value, Choice) and variable.kind != "string":
            for one in value.values:
                checked_value(variable, one)
        return value
    return str.__str__(value) if variable.kind == "string" else checked_value(variable, value)


def checked_column(variable: Variable, values: Sequence[Any]) -> npt.NDArray[Any]:
    """Check the values of a parameter in N environments.

    Returns:
        Numbers, or the texts of a String as objects, shape (N,).

    Raises:
        ConfigError: If the variable cannot start with one of them.
    """
    if variable.kind != "string":
        return np.array([checked_value(variable, value) for value in values])
    for value in values:
        _require_text(variable.name, value)
    return np.array([str.__str__(value) for value in values], object)


def start_time_of(env: Any) -> Any:
    """The first communication point of an environment's episode, in s; or of N as hooks read it."""
    if env.config.draws_start_time:
        return env.parameters["start_time"]
    return env.pool_spec.start_time
