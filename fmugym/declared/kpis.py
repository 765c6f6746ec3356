"""Figures that tell how good an episode was: what is computed of the values in its steps."""

from __future__ import annotations

from typing import Final, NamedTuple

from fmugym.declared.entries import Entry
from fmugym.declared.expressions import Expression

__all__ = ["KPIS", "Kpi", "kpi_name", "read_kpi"]

KPIS: Final = ("sum", "mean", "min", "max", "last")
"""What a figure may be of the values in the steps of an episode."""


class Kpi(NamedTuple):
    """A figure of an episode.

    Attributes:
        entry: Where it stands.
        expression: Its value in a step; or an expression of other figures.
        how: One of ``KPIS``; None for an expression of other figures.
    """

    entry: Entry
    expression: Expression
    how: str | None

    def updated(self, value: str) -> str:
        """Code for what the task remembers of a figure after a step.

        Args:
            value: Code for the value in the step.
        """
        before = f"env.variables[{kpi_name(self.entry.name)!r}]"
        match self.how:
            case "sum" | "mean":
                return f"({before} + {value})"
            case "min" | "max":
                return f"where((env.step_count == 1), {value}, fn_{self.how}({before}, {value}))"
        return value

    @property
    def present(self) -> str:
        """Code for the figure, of all steps until now."""
        value = f"env.variables[{kpi_name(self.entry.name)!r}]"
        return f"({value} / fn_max(env.step_count, 1.0))" if self.how == "mean" else value


def kpi_name(name: str) -> str:
    """The episode variable in which a figure is kept."""
    return f"kpi {name}"


def read_kpi(entry: Entry) -> Kpi:
    """Read a figure."""
    how = next(how for how in (*KPIS, "expr") if how in entry.value)
    return Kpi(entry, entry.value[how], None if how == "expr" else how)
