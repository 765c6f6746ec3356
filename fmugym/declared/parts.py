"""What the sections of a task consist of, and how it is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.declared.entries import Entry
from fmugym.declared.expressions import Expression
from fmugym.declared.values import number, number_or_distribution

__all__ = [
    "Derived",
    "Limits",
    "Memory",
    "Term",
    "read_derived",
    "read_expression",
    "read_limits",
    "read_memory",
    "read_term",
    "section_of",
]

Limits = tuple[float, float]


@dataclass(frozen=True)
class Term:
    """A named reward or cost.

    Attributes:
        entry: Where it stands.
        expression: Its value in a step.
        weight: The factor of a reward.
        limit: What the costs of an episode may add up to; None for no limit.
    """

    entry: Entry
    expression: Expression
    weight: float = 1.0
    limit: float | None = None


@dataclass(frozen=True)
class Memory:
    """A value that the task itself remembers during an episode.

    Attributes:
        entry: Where it stands.
        start: Its value at the beginning: a number or a distribution.
        update: Its value after a step; None to keep it.
        limits: For the observation space.
    """

    entry: Entry
    start: Any
    update: Expression | None
    limits: Limits


@dataclass(frozen=True)
class Derived:
    """A named expression, and its limits for the observation space."""

    entry: Entry
    expression: Expression
    limits: Limits


def section_of(root: Entry, name: str) -> list[Entry]:
    """The entries of a section; none if the task does not have it."""
    section = root.child(name)
    return [] if section.value is None else list(section.items().values())


def read_expression(entry: Entry) -> Expression:
    """The expression in an entry."""
    with entry.placing():
        return Expression.parse(entry.value)


def read_memory(entry: Entry) -> Memory:
    """Read a value that the task remembers."""
    is_table = isinstance(entry.value, Mapping) and "distribution" not in entry.value
    if not is_table:
        return Memory(entry, number_or_distribution(entry), None, (-np.inf, np.inf))
    table = entry.table(("start", "update", "min", "max"))
    start = number_or_distribution(entry.required("start"))
    update = read_expression(table["update"]) if "update" in table else None
    return Memory(entry, start, update, read_limits(entry))


def read_derived(entry: Entry) -> Derived:
    """Read a named expression."""
    if not isinstance(entry.value, Mapping):
        return Derived(entry, read_expression(entry), (-np.inf, np.inf))
    entry.table(("expr", "min", "max"))
    return Derived(entry, read_expression(entry.required("expr")), read_limits(entry))


def read_term(entry: Entry, keys: tuple[str, ...]) -> Term:
    """Read a reward or a cost, whose table may have these keys."""
    if not isinstance(entry.value, Mapping):
        return Term(entry, read_expression(entry))
    table = entry.table(keys)
    weight = number(table["weight"]) if "weight" in table else 1.0
    limit = number(table["limit"]) if "limit" in table else None
    return Term(entry, read_expression(entry.required("expr")), weight, limit)


def read_limits(entry: Entry) -> Limits:
    """Read ``min`` and ``max`` of a table; infinite where they are missing."""
    low, high = entry.child("min"), entry.child("max")
    limits = (
        -np.inf if low.value is None else number(low),
        np.inf if high.value is None else number(high),
    )
    if not limits[0] < limits[1]:
        raise entry.error(f"min must be below max, got {limits[0]} and {limits[1]}")
    return limits
