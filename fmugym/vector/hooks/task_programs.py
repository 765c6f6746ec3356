"""The programs of a task: before the step of the FMU, and after it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.expressions.graph import Graph
from fmugym.expressions.lowering import Store, compile_graph
from fmugym.expressions.program import Program
from fmugym.expressions.value import Value, where

__all__ = ["SeenArray", "TaskPrograms", "to_input_type"]


@dataclass(frozen=True)
class SeenArray:
    """An array of observations or infos that a program stores.

    Attributes:
        path: The keys that lead to it: ``"observation"`` or ``"info"``, then names.
        shape: The shape of one environment's part.
        dtype: Its type.
    """

    path: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


@dataclass(frozen=True)
class TaskPrograms:
    """The programs of a task.

    Attributes:
        inputs: From the action to the inputs.
        conclusion: From the outputs to done, truncated and reward; it stores the episode variables,
            the observation if it is not the default one, and the info.
        seen: The arrays that the second program stores.
        variables: The types of the episode variables by name.
        updated: The names of the variables that ``_update`` writes.
    """

    inputs: Program
    conclusion: Program
    seen: tuple[SeenArray, ...]
    variables: Mapping[str, np.dtype[Any]]
    updated: tuple[str, ...]

    @classmethod
    def without_programs(cls, variables: Iterable[str], inputs: int) -> TaskPrograms:
        """A task whose hooks run on arrays; programs pass on inputs, and that an FMU stops.

        Args:
            variables: The names of the episode variables, which are float64 at first.
            inputs: The number of inputs.
        """
        graph, flag = Graph(), np.dtype(np.bool_)
        stopped = graph.load("stopped", None, flag)
        others = graph.constant(False, flag), graph.constant(0.0, np.dtype(np.float64))
        conclusion = compile_graph(graph, [], [stopped, *others], 0)
        types = dict.fromkeys(variables, np.dtype(np.float64))
        graph = Graph()
        given = [graph.load("row", ("given", i), np.dtype(np.float64)) for i in range(inputs)]
        stores = [Store(node, ("input", i)) for i, node in enumerate(given)]
        return cls(compile_graph(graph, stores, [], 0), conclusion, (), types, ())

    def with_tables(self, tables: Mapping[bytes, npt.NDArray[Any]]) -> TaskPrograms:
        """The same task with other tables, by the bytes of those whose place they take."""
        inputs, conclusion = (one.with_tables(tables) for one in (self.inputs, self.conclusion))
        return replace(self, inputs=inputs, conclusion=conclusion)


def to_input_type(variable: Variable, value: Value) -> Value:
    """Round a value to its input's type, as ``to_input_types`` does.

    A value that is outside of the type's range becomes NaN, which no pool steps with.
    """
    if variable.type in {"Real", "Float64"}:
        return value
    if variable.kind == "boolean":
        return where(_is_finite(value), where(value >= 0.5, 1.0, 0.0), value)
    if variable.kind in {"integer", "enumeration"}:
        return _to_integer(variable, value)
    limit = float(np.finfo(np.float32).max)
    size: Value = np.absolute(value)
    return where(size <= limit, value, np.nan)


def _to_integer(variable: Variable, value: Value) -> Value:
    """The nearest integer, or the nearest item of an Enumeration; NaN outside of the range."""
    low, high = variable.integer_limits
    largest = 2.0**53
    rounded: Any = np.rint(value) + 0.0  # has no negative zero
    items = [item for _, item in variable.items]
    if items:
        low, high = min(items), max(items)
        rounded = _nearest(items, rounded)
    within = (rounded >= float(max(low, -largest))) & (rounded <= float(min(high, largest)))
    return where(within, rounded, where(_is_finite(value), np.nan, value))


def _is_finite(value: Value) -> Value:
    return (value - value) <= 0.0


def _nearest(items: list[int], value: Value) -> Value:
    """The nearest of some items, the first of those that are as near; others stay."""
    if set(items) == set(range(min(items), max(items) + 1)):
        return value
    nearest = value.beside(float(items[0]))
    for item in items[1:]:
        here, there = (np.absolute(value - one) for one in (float(item), nearest))
        is_nearer: Any = here < there
        nearest = where(is_nearer, float(item), nearest)
    inside = (value >= float(min(items))) & (value <= float(max(items)))
    return where(inside, nearest, value)
