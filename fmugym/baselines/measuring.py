"""Signals of controllers: expressions of observed values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from fmugym.checks import Spellings
from fmugym.expressions.by_numpy import function_of
from fmugym.expressions.graph import Graph
from fmugym.expressions.language import Expression, Names
from fmugym.expressions.value import Value

__all__ = ["Formula", "formula_of", "of_columns"]

Formula = Callable[[Sequence[Value]], Value]
"""A function of the elements of an observation."""


def formula_of(text: str, names: Sequence[str]) -> Formula:
    """Make the formula of a signal.

    Args:
        text: An expression.
        names: What its names may be: those of the elements of an observation.

    Returns:
        The formula. It raises ``ConfigError`` if the expression has other names.

    Raises:
        ConfigError: If it is no expression.
    """
    expression, spellings = Expression.parse(text), Spellings("observation", names)

    def formula(observation: Sequence[Value]) -> Value:
        def find(name: str) -> Value | None:
            spelt = spellings.find(name)
            return None if spelt is None else observation[names.index(spelt)]

        graph = observation[0].graph
        return expression.value(Names(graph, find, known=lambda: list(names))).number

    return formula


def of_columns(formula: Formula, width: int) -> Callable[[Sequence[Any]], Any]:
    """The function of the elements of observations, each of shape (N,), that gives the values."""
    graph = Graph()
    value = formula([Value.read(graph, "columns", place) for place in range(width)])
    constant = value.constant
    if constant is not None:
        return lambda columns: np.full(len(columns[0]), float(constant))
    evaluate = function_of(value)
    return lambda columns: evaluate(SimpleNamespace(columns=columns))
