"""Signals of controllers: expressions of what they observe."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fmugym.checks import Spellings
from fmugym.expressions.language import Expression, Names
from fmugym.expressions.value import Value

__all__ = ["signal_of"]


def signal_of(text: str, names: Sequence[str]) -> Callable[[Sequence[Value]], Value]:
    """Make the function of observations that an expression is.

    Args:
        text: The expression.
        names: What its names may be: those of the elements of an observation.

    Returns:
        A function of the elements of an observation. It raises ``ConfigError`` if the expression
        has other names.

    Raises:
        ConfigError: If it is no expression.
    """
    expression, spellings = Expression.parse(text), Spellings("observation", names)

    def signal(observation: Sequence[Value]) -> Value:
        def find(name: str) -> Value | None:
            spelt = spellings.find(name)
            return None if spelt is None else observation[names.index(spelt)]

        graph = observation[0].graph
        return expression.value(Names(graph, find, known=lambda: list(names))).number

    return signal
