"""Explanation of a declared reward that is not finite: its term, place and values."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from fmugym.declared.naming import Moment, Naming
from fmugym.declared.section_entries import Term
from fmugym.expressions.by_numpy import function_of
from fmugym.expressions.language import CONSTANTS, Expression
from fmugym.expressions.value import Value

__all__ = ["explanation"]


def explanation(
    terms: Mapping[str, Term],
    values: Mapping[str, Value],
    naming: Naming,
) -> Callable[[Any, float], str]:
    """Make a method of an environment that explains a reward.

    Args:
        terms: The terms of the reward by name.
        values: Their values, weights included.
        naming: Gives the values that the terms read.
    """
    parts = [
        (name, term, function_of(values[name]), _readers(term, naming))
        for name, term in terms.items()
    ]

    def explain(env: Any, reward: float) -> str:
        found = [(name, term, float(value(env)), read) for name, term, value, read in parts]
        wrong = [one for one in found if not math.isfinite(one[2])]
        if not wrong:
            listing = ", ".join(f"{name} = {value:g}" for name, _, value, _ in found)
            return f"the reward is {reward}, the sum of {listing}"
        _, term, value, readers = wrong[0]
        values = ", ".join(f"{text} = {float(read(env)):g}" for text, read in readers.items())
        place = term.entry.source.place(term.entry.keys)
        told = f", where {values}" if values else ""
        return f"{place}: the reward {term.expression.text!r} is {value}{told},"

    return explain


def _readers(term: Term, naming: Naming) -> dict[str, Callable[[Any], Any]]:
    """Functions that read the values of a term, by the texts of these values."""
    names = sorted(term.expression.names - CONSTANTS.keys())
    before = sorted(term.expression.previous_names)
    return {
        text: function_of(naming.value(term.entry, Expression.parse(text), Moment.JUDGED).number)
        for text in (*names, *(f"previous({name})" for name in before))
    }
