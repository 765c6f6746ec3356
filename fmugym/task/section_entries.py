"""Entries of the sections of a task: memory, named expressions, rewards, costs and KPIs.

KPIs are sums, means and other figures of the values in the steps of an episode.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fmugym.expressions.functions import maximum, minimum
from fmugym.expressions.graph import Value, where
from fmugym.expressions.language import Expression
from fmugym.task.task_entries import Entry
from fmugym.task.task_keys import KPI

__all__ = [
    "Derived",
    "Kpi",
    "Limits",
    "MemoryVariable",
    "Term",
    "kpi_name",
    "read_derived",
    "read_kpi",
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


class Kpi(NamedTuple):
    """A figure of an episode.

    Attributes:
        entry: Entry of the task.
        expression: Its value in a step; or an expression of other figures.
        how: The key of the format that has the expression; None for an expression of other figures.
    """

    entry: Entry
    expression: Expression
    how: str | None

    def updated(self, value: Value, step_count: Value) -> Value:
        """Value of a figure in the memory of the task after a step.

        Args:
            value: The value in the step.
            step_count: The number of the step.
        """
        before = self._remembered(step_count)
        match self.how:
            case "sum" | "mean":
                return before + value
            case "min":
                return where(step_count == 1, value, minimum(before, value))
            case "max":
                return where(step_count == 1, value, maximum(before, value))
        return value

    def present(self, step_count: Value) -> Value:
        """The figure of all steps until now."""
        value = self._remembered(step_count)
        return value / maximum(step_count, 1.0) if self.how == "mean" else value

    def _remembered(self, step_count: Value) -> Value:
        return Value.read(step_count.graph, "variables", kpi_name(self.entry.name))


def kpi_name(name: str) -> str:
    """The episode variable in which a figure is kept."""
    return f"kpi {name}"


def read_kpi(entry: Entry) -> Kpi:
    """Read a figure."""
    how = next((how for how in KPI.one_of if how in entry.value), KPI.short)
    return Kpi(entry, entry.required(how).value, None if how == KPI.short else how)
