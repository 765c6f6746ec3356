"""Numbers and distributions of a task."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from fmugym.checks import check_mapping, check_number, number_of
from fmugym.declared.expressions import Expression
from fmugym.distributions import as_distribution, is_distribution

__all__ = ["finite", "number", "number_or_distribution"]


def number(what: str, value: Any) -> float:
    """A number of a task: a number, or a text with an expression of constants, such as ``pi / 2``.

    Raises:
        ConfigError: If it is neither.
    """
    if isinstance(value, str):
        return Expression.parse(value).constant()
    return number_of(what, value, may_be_boolean=True)


def finite(what: str, value: Any) -> float:
    """A finite number of a task, as ``number``."""
    return check_number(what, number(what, value), may_be_boolean=True)


def number_or_distribution(what: str, value: Any, read: Callable[[str, Any], Any] = finite) -> Any:
    """A number, or a distribution, whose numbers may be texts with expressions of constants.

    Args:
        what: Its name, for the error.
        value: As the user gave it.
        read: Reads what is no distribution.

    Raises:
        ConfigError: If it is neither.
    """
    if is_distribution(value):
        return value
    if not isinstance(value, Mapping):
        return read(what, value)
    items = check_mapping(what, value)
    for name in items.keys() - {"distribution", "values", "probabilities"}:
        items[name] = number(name, items[name])
    return as_distribution(what, items)
