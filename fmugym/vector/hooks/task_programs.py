"""The programs of a task: before the step of the FMU, and after it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.expressions.graph import Graph
from fmugym.expressions.lowering import Store, compile_graph
from fmugym.expressions.program import TYPES, Program, letter_of
from fmugym.expressions.value import Value, where

__all__ = ["SeenArray", "TaskPrograms", "counted", "ended", "seen_stores", "to_input_type"]

_FLAG, _COUNT = np.dtype(np.bool_), np.dtype(np.int64)


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
        inputs: From the action to the inputs; it counts the step.
        conclusion: From the outputs to the episode variables, the results of the step, and which
            episodes have ended; and to the observation, if it is not the default one, and the info.
        observation: To these two alone, at the start of an episode.
        seen: The arrays of observations and infos that programs store.
        variables: The types of the episode variables by name.
        updated: The names of the variables that ``_update`` writes.
    """

    inputs: Program
    conclusion: Program
    observation: Program
    seen: tuple[SeenArray, ...]
    variables: Mapping[str, np.dtype[Any]]
    updated: tuple[str, ...]

    @classmethod
    def without_programs(cls, variables: Iterable[str], inputs: int, limit: int) -> TaskPrograms:
        """A task whose hooks run on arrays; programs pass on inputs, and that an FMU stops.

        Args:
            variables: The names of the episode variables, which are float64 at first.
            inputs: The number of inputs.
            limit: The steps after which an episode is truncated.
        """
        graph, real = Graph(), np.dtype(np.float64)
        stopped = Value(graph, graph.load("stopped", None, _FLAG))
        never, nothing = Value.of(graph, False), Value.of(graph, 0.0)
        conclusion = compile_graph(graph, ended(stopped, never, nothing, limit))
        graph = Graph()
        given = [graph.load("row", ("given", i), real) for i in range(inputs)]
        stores = [Store(node, ("input", i)) for i, node in enumerate(given)]
        return cls(
            compile_graph(graph, [*stores, counted(graph)]),
            conclusion,
            compile_graph(Graph(), []),
            (),
            dict.fromkeys(variables, real),
            (),
        )

    def with_tables(self, tables: Mapping[bytes, npt.NDArray[Any]]) -> TaskPrograms:
        """The same task with other tables, by the bytes of those whose place they take."""
        programs = (self.inputs, self.conclusion, self.observation)
        inputs, conclusion, observation = (one.with_tables(tables) for one in programs)
        return replace(self, inputs=inputs, conclusion=conclusion, observation=observation)


def counted(graph: Graph) -> Store:
    """Count a step, but none of an environment that starts an episode instead."""
    is_fresh, count = _row(graph, "ended", _FLAG), _row(graph, "step_count", _COUNT)
    none, more = Value.of(graph, 0).cast(_COUNT), (count + 1).cast(_COUNT)
    return Store(graph.choose(is_fresh.node, none.node, more.node), ("step_count", 0))


def ended(terminated: Value, truncated: Value, reward: Value, limit: int) -> list[Store]:
    """Store the results of a step, and which episodes have ended.

    An environment that has started an episode instead of a step has no reward and no end.

    Args:
        terminated: Where tasks have ended.
        truncated: Where they are cut.
        reward: The rewards.
        limit: The steps after which an episode is truncated, too.
    """
    graph = terminated.graph
    is_fresh = _row(graph, "ended", _FLAG)
    has_stepped: Value = np.logical_not(is_fresh)
    if limit < sys.maxsize:
        truncated = truncated | (_row(graph, "step_count", _COUNT) >= limit)
    terminated, truncated = terminated & has_stepped, truncated & has_stepped
    results = {
        "reward": where(is_fresh, 0.0, reward),
        "terminated": terminated,
        "truncated": truncated,
        "done": terminated,
        "ended": terminated | truncated,
    }
    return [Store(value.node, (kind, 0)) for kind, value in results.items()]


def seen_stores(number: int, values: Sequence[Value]) -> list[Store]:
    """Store the elements of an array of observations or infos, which has this number."""
    letter, count = letter_of(values[0].dtype), len(values)
    return [
        Store(value.node, ("seen", number, place, count, TYPES.index(letter)))
        for place, value in enumerate(values)
    ]


def _row(graph: Graph, kind: str, dtype: np.dtype[Any]) -> Value:
    return Value(graph, graph.load("row", (kind, 0), dtype))


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
