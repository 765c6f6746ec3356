"""Signals of controllers: expressions of what they observe."""

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

__all__ = ["signal_of"]


def signal_of(text: str, names: Sequence[str]) -> Callable[[Any], Any]:
    """Make the function of observations that an expression is.

    Args:
        text: The expression.
        names: What its names may be: those of the elements of an observation.

    Returns:
        A function of observations of shape (N, k), numbers or symbols, that returns shape (N,).

    Raises:
        ConfigError: If it is no expression, or has other names.
    """
    graph, spellings = Graph(), Spellings("observation", names)

    def find(name: str) -> Value | None:
        spelt = spellings.find(name)
        return None if spelt is None else Value.read(graph, "columns", names.index(spelt))

    value = Expression.parse(text).value(Names(graph, find, known=lambda: list(names))).number
    evaluate = function_of(value)

    def signal(rows: Any) -> Any:
        if value.constant is not None:
            return np.full(len(rows), float(value.constant))
        return evaluate(SimpleNamespace(columns=[rows[:, place] for place in range(len(names))]))

    return signal
