"""Variables of an FMU in an environment: inputs, outputs, and start values with their ranges.

The functions say which variables may be what, and with which values episodes start. A range comes
from the config, or else from the FMU.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.checks import parts_of_array
from fmugym.environment.distributions import (
    Choice,
    as_distribution,
    is_distribution,
    support_of,
    truncated,
)
from fmugym.errors import ConfigError, shown, warn_once
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.variable import Variable, checked_value, unknown_rest

__all__ = [
    "check_input",
    "check_output",
    "check_readable",
    "check_rest_is_known",
    "checked",
    "checked_column",
    "require_not_driven",
    "require_numeric",
    "spread",
    "start_time_of",
    "start_values",
    "start_variable",
    "structural_values",
    "texts_in",
    "within",
]

_CURES: Final = {
    "String": ". 'model_parameters' can give a scalar String the text that it starts with; to read "
    "what a String tells, let the FMU tell the same by a number or an Enumeration",
    "Binary": ". Nobody but the FMU knows what its bytes mean: let it tell what you need by "
    "numbers",
}


def check_input(description: ModelDescription, variable: Variable) -> None:
    """Check that a variable can be written before every step.

    Raises:
        ConfigError: If it cannot.
    """
    require_numeric(variable, "an input")
    _require_known_clock(description, variable, "an input")
    if not variable.settable_in_step:
        require_not_driven(description, variable, "be an input")
        raise ConfigError(
            f"{variable.name!r} cannot be an input: it is a {variable.variability} "
            f"{variable.causality}; only inputs and tunable parameters may be set between steps"
        )


def require_not_driven(description: ModelDescription, variable: Variable, what: str) -> None:
    """Check that no connection of a system gives a variable its values.

    Args:
        description: That of the FMU or the system.
        variable: One of its variables.
        what: What the variable cannot do if it is driven, for the message.

    Raises:
        ConfigError: If something drives it.
    """
    source = description.what_drives(variable)
    if source is not None:
        raise ConfigError(
            f"{variable.name!r} cannot {what}: the system connects it with {source!r}, which gives "
            "it its value"
        )


def check_output(description: ModelDescription, variable: Variable) -> None:
    """Check that a variable can be read after every step, and observed.

    Raises:
        ConfigError: If it cannot.
    """
    require_numeric(variable, "an output")
    _require_known_clock(description, variable, "an output")


def check_readable(description: ModelDescription, variable: Variable) -> None:
    """Check a variable that is read, but not observed; see ``check_output``.

    Raises:
        ConfigError: If it cannot be read.
    """
    require_numeric(variable, "read in episodes")
    _require_known_clock(description, variable, "read in episodes")


def _require_known_clock(description: ModelDescription, variable: Variable, role: str) -> None:
    if not variable.ticking:
        return
    if variable not in description.clocks:
        raise ConfigError(
            f"{variable.name!r} cannot be {role}: it is a clock, and {description.model_name} has "
            "no event mode in co-simulation"
        )
    if role == "an input" and not variable.settable_in_step:
        raise ConfigError(
            f"{variable.name!r} cannot be {role}: it is a clock of "
            f"causality={variable.causality!r} and intervalVariability={variable.ticking!r}, which "
            "ticks by itself; only triggered input clocks may be set"
        )


def require_numeric(variable: Variable, role: str) -> None:
    """Check that a variable is a number, or a clock.

    Raises:
        ConfigError: If it is not; the message names the role that it should have.
    """
    if variable.numeric or variable.ticking:
        return
    if variable.is_number:
        raise ConfigError(
            f"{variable.name!r} cannot be {role}: it is an array; name its elements, as in "
            f"'{variable.name}[1]'"
        )
    element = "" if variable.array is None else "an element of an array "
    raise ConfigError(
        f"{variable.name!r} cannot be {role}: it is {element}of type {variable.type}; "
        f"expected a Real, Integer, Boolean or Enumeration{_CURES.get(variable.type, '')}"
    )


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


_OF_FMU: Final = (
    "the FMU's min and max (another range: 'bounds', or 'min' and 'max' in a task file)"
)
_GIVEN: Final = "the range that the task gives"

logger = logging.getLogger(__name__)


def within(variable: Variable, value: Any) -> Any:
    """Check that a start value lies in its range, and truncate an unbounded distribution there.

    The log tells once in a process what is truncated.

    Args:
        variable: A scalar or an element of an array, with the bounds of the task.
        value: A checked number or text, or a distribution.

    Returns:
        The value, or a distribution that only draws values in the range.

    Raises:
        ConfigError: If the number or a bounded distribution exceeds the range, or an unbounded one
            hardly ever draws a value in it.
    """
    if variable.kind not in {"real", "integer"}:
        return value
    low, high = variable.bounds or variable.limits
    ends = support_of(value) if is_distribution(value) else (value, value)
    if _lies_in(low, ends[0], high) and _lies_in(low, ends[1], high):
        return value
    if variable.bounds is None and _limits_exclude_start(variable):
        return value
    unit = "" if variable.unit in (None, "", "1") else f" {variable.unit}"
    text = f"{low} and {high}{unit}, {_GIVEN if variable.bounds else _OF_FMU}"
    if all(map(math.isfinite, ends)):
        found = shown(value) if ends[0] == ends[1] else f"{ends[0]} to {ends[1]} of {shown(value)}"
        raise _outside(variable, text, found)
    try:
        own = truncated(value, low, high)
    except ConfigError as error:
        raise _outside(variable, text, error) from None
    warn_once(logger, f"{variable.name!r} is drawn again until it lies between {text}")
    return own


def _limits_exclude_start(variable: Variable) -> bool:
    """Whether the FMU's limits exclude its own start value, so that they cannot be meant."""
    low, high = variable.limits
    try:
        return variable.start is not None and not _lies_in(low, variable.start_number, high)
    except ConfigError:  # no number
        return False


def _lies_in(low: float, value: float, high: float) -> bool:
    """Conversions between units may round a value that is at a limit."""
    return low <= value <= high or math.isclose(value, low) or math.isclose(value, high)


def _outside(variable: Variable, wanted: str, found: object) -> ConfigError:
    return ConfigError(f"{variable.name!r} must lie between {wanted}; got {found}")
