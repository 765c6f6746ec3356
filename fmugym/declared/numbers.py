"""Numbers and distributions of a task."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from fmugym.checks import check_mapping, check_number, number_of
from fmugym.declared.entries import Entry
from fmugym.distributions import as_distribution, is_distribution
from fmugym.errors import ConfigError, ConsequenceError, nearest_name, shown
from fmugym.expressions.language import CONSTANTS, Expression
from fmugym.pool.spec import whole_number_of_steps

__all__ = ["constant_of", "finite", "nearest_steps", "number", "number_or_distribution", "steps_in"]


def nearest_steps(length: float, step: float) -> int:
    """The number of steps that is nearest to a duration.

    Raises:
        ConsequenceError: If the step is not a number, because the task has a mistake there.
    """
    _require_known(step)
    return round(length / step)


def _require_known(step: float) -> None:
    if math.isnan(step):
        raise ConsequenceError("the time step is not known")


def steps_in(entry: Entry, length: float, step: float, most: float = math.inf) -> int:
    """The number of steps in a duration.

    Args:
        entry: Entry of the task.
        length: The duration in seconds.
        step: The length of a step in seconds.
        most: There may be at most so many.

    Raises:
        ConfigError: If it is no positive multiple of the step, or there are more.
    """
    _require_known(step)
    count = whole_number_of_steps(length, step) if step > 0 else None
    if not count:
        raise entry.error(
            f"expected a positive multiple of the step of {step:g} s, got {length:g} s"
        )
    if count > most:
        raise entry.error(f"{length:g} s are {count} steps of {step:g} s, at most {most}")
    return count


def number(what: str, value: Any) -> float:
    """A number of a task: a number, or a text with an expression of constants, such as ``pi / 2``.

    Raises:
        ConfigError: If it is neither.
    """
    if isinstance(value, str):
        return constant_of(what, value)
    return number_of(what, value, may_be_boolean=True)


def constant_of(what: str, text: str) -> float:
    """The value of an expression of constants.

    Raises:
        ConfigError: If it is none.
    """
    expression = Expression.parse(text)
    if expression.names <= CONSTANTS.keys():
        return expression.constant()
    near = nearest_name(text, [*CONSTANTS])
    hint = "" if near is None else f"; did you mean {near!r}?"
    raise ConfigError(
        f"{what} must be a number, or an expression of constants such as '24 * pi / 180', got "
        f"{shown(text)}{hint}"
    )


def finite(what: str, value: Any) -> float:
    """A finite number of a task, as ``number``."""
    return check_number(what, number(what, value), may_be_boolean=True)


def number_or_distribution(
    what: str,
    value: Any,
    read: Callable[[str, Any], Any] = finite,
    *,
    draws_texts: bool = False,
) -> Any:
    """A number, or a distribution, whose numbers may be texts with expressions of constants.

    Args:
        what: Its name, for the error.
        value: As the user gave it.
        read: Reads what is no distribution.
        draws_texts: Whether texts among the values of a choice stand for themselves.

    Raises:
        ConfigError: If it is neither.
    """
    if is_distribution(value):
        return value
    if not isinstance(value, Mapping):
        return read(what, value)
    items = check_mapping(what, value)
    for name, given in items.items():
        if isinstance(given, list | tuple) and not (draws_texts and name == "values"):
            items[name] = [number(name, one) if isinstance(one, str) else one for one in given]
        elif name not in {"distribution", "values", "probabilities"}:
            items[name] = number(name, given)
    return as_distribution(what, items)
