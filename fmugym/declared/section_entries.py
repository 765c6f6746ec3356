"""Entries of the sections of a task: memory, named expressions, rewards and costs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.declared.entries import Entry
from fmugym.expressions.language import Expression

__all__ = [
    "Derived",
    "Limits",
    "MemoryVariable",
    "Term",
    "read_derived",
    "read_limits",
    "read_memory",
    "read_term",
]

Limits = tuple[float, float]


@dataclass(frozen=True)
class Term:
    """A named reward or cost.

    Attributes:
        entry: Entry of the task.
        expression: Its value in a step.
        weight: The factor of a reward.
        limit: Limit of the costs of an episode; None for no limit.
    """

    entry: Entry
    expression: Expression
    weight: float = 1.0
    limit: float | None = None


@dataclass(frozen=True)
class MemoryVariable:
    """A variable that the task keeps from step to step.

    Attributes:
        entry: Entry of the task.
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


def read_memory(entry: Entry) -> MemoryVariable:
    """Read an entry of ``[memory]``."""
    start = entry.required("start").value
    return MemoryVariable(entry, start, entry.value.get("update"), read_limits(entry))


def read_derived(entry: Entry) -> Derived:
    """Read a named expression."""
    return Derived(entry, entry.required("expr").value, read_limits(entry))


def read_term(entry: Entry) -> Term:
    """Read a reward or a cost."""
    expression, table = entry.required("expr").value, entry.value
    return Term(entry, expression, table.get("weight", 1.0), table.get("limit"))


def read_limits(entry: Entry, low: float = -np.inf, high: float = np.inf) -> Limits:
    """Read ``min`` and ``max`` of a table; other limits take the place of missing ones."""
    given = entry.value or {}
    return given.get("min", low), given.get("max", high)
