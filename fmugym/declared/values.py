"""Numbers and distributions in the entries of a task."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fmugym.checks import check_mapping, number_of
from fmugym.declared.entries import Entry
from fmugym.declared.expressions import Expression
from fmugym.distributions import as_distribution, is_distribution

__all__ = ["number", "number_or_distribution"]


def number(entry: Entry) -> float:
    """A number of a task: a number, or a text with an expression of constants, such as ``pi / 2``.

    Raises:
        ConfigError: If it is neither.
    """
    with entry.placing():
        if isinstance(entry.value, str):
            return Expression.parse(entry.value).constant()
        return number_of(entry.name, entry.value, may_be_boolean=True)


def number_or_distribution(entry: Entry) -> Any:
    """A number, or a distribution, whose numbers may be texts with expressions of constants.

    Raises:
        ConfigError: If it is neither.
    """
    if is_distribution(entry.value):
        return entry.value
    if not isinstance(entry.value, Mapping):
        value = number(entry)
        if not math.isfinite(value):
            raise entry.error(f"expected a finite number, got {value}")
        return value
    with entry.placing():
        items = check_mapping(entry.name, entry.value)
        for name in items.keys() - {"distribution", "values", "probabilities"}:
            items[name] = number(entry.child(name))
        return as_distribution(entry.name, items)
