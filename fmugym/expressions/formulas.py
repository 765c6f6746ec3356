"""Formulas of a task around the steps of its FMU: updates, rewards and ends in one graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fmugym.expressions.graph import Graph
from fmugym.expressions.value import Computed, Value

__all__ = ["Formulas", "Update"]

Update = Mapping[str, Value | Sequence[Value]]
"""New values of episode variables by name; all of them are computed before one is written."""


@dataclass(frozen=True)
class Formulas:
    """The formulas of a task, in the order of a step.

    Attributes:
        graph: Has all of them.
        inputs: The FMU's inputs; None for the elements of the action.
        updates: Values that are written to episode variables after a step, one after the other.
        terminated: Whether the task has ended; None for never.
        truncated: Whether the episode is cut off; None for never.
        reward: The reward; None if a hook of a class tells it.
        observation: The elements of the observation; None for the outputs.
        info: Facts about the step by name.
    """

    graph: Graph
    inputs: Sequence[Value] | None
    updates: Sequence[Update]
    terminated: Value | None
    truncated: Value | None
    reward: Value | None
    observation: Sequence[Value] | None
    info: Mapping[str, Computed]
