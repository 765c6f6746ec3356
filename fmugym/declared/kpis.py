"""KPIs: sums, means and other figures of the values in the steps of an episode."""

from __future__ import annotations

from typing import NamedTuple

from fmugym.declared.entries import Entry
from fmugym.declared.format import KPI
from fmugym.expressions.language import Expression
from fmugym.expressions.mathematics import maximum, minimum
from fmugym.expressions.value import Value, where

__all__ = ["Kpi", "kpi_name", "read_kpi"]


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
