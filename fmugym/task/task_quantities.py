"""Quantities of a task: all of its names that have a value.

They explain a reward that is not finite: by its term, its place and the values that it reads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from fmugym.environment.episode import Quantity
from fmugym.errors import ConfigError
from fmugym.expressions.graph import Value
from fmugym.expressions.language import CONSTANTS, Expression
from fmugym.expressions.numpy_evaluation import function_of
from fmugym.task.declarations import Declarations
from fmugym.task.section_entries import Term
from fmugym.task.task_names import Moment, Naming

__all__ = ["explanation", "named_values"]


def named_values(naming: Naming) -> dict[str, tuple[Quantity, Value]]:
    """Quantities of a task by name, each with the expression of its value between steps.

    Args:
        naming: Gives names their values. Names without a value are left out.
    """
    found: dict[str, tuple[Quantity, Value]] = {}
    for quantity in _quantities(naming):
        value = _value(naming, quantity.name)
        if value is not None:
            found.setdefault(quantity.name, (quantity, value))
    return found


def _quantities(naming: Naming) -> Iterator[Quantity]:
    declared = naming.declared
    actions = [variable.alias for variable in declared.actions]
    for alias in [*actions, *naming.read_names]:
        yield _of_variable(declared, alias, "action" if alias in actions else "output")
    setpoints = declared.root.child("setpoints").value or {}
    targets = _targets(declared)
    for name in setpoints:
        yield _of_name(declared, name, "setpoint", targets.get(name, ""))
    for kind in ("data", "memory", "expressions"):
        for name in declared.root.child(kind).value or {}:
            yield _of_name(declared, name, kind.removesuffix("s"))
    for alias in declared.inputs:
        yield _of_variable(declared, alias, "input")
    for alias in declared.parameters:
        yield _of_variable(declared, alias, "parameter")


def _of_variable(declared: Declarations, alias: str, kind: str) -> Quantity:
    variable = declared.variables[alias]
    return Quantity(alias, kind, _shown(variable.unit), *variable.limits)


def _shown(unit: str | None) -> str:
    """The unit; none for numbers without one, which FMI writes as 1."""
    return "" if unit in (None, "1") else str(unit)


def _of_name(declared: Declarations, name: str, kind: str, target: str = "") -> Quantity:
    """The quantity of a name that is no variable; a set point has the unit of its variable."""
    series = declared.series.get(name)
    unit = "" if series is None else _shown(series.unit)
    if target and not unit:
        unit = _shown(declared.variables[target].unit)
    holds = name in declared.steps or (series is not None and series.is_stepped)
    return Quantity(name, kind, unit, *declared.limits_of(name), holds, target)


def _targets(declared: Declarations) -> dict[str, str]:
    """By set point, the variable that it is for: as declared, or else in a difference somewhere."""
    setpoints = declared.root.child("setpoints").value or {}
    found = {one.setpoint: one.of for one in declared.deviations.values()}
    for expression in declared.expressions:
        for sides in expression.differences(or_comparisons=True):  # of one unit
            for name, other in (sides, sides[::-1]):
                if name in setpoints and declared.is_output(other):
                    found.setdefault(name, other)
    return found


def _value(naming: Naming, name: str) -> Value | None:
    """The value of a name between two steps; None if it only has one within a step."""
    for moment in (Moment.SEEN, Moment.JUDGED):
        try:
            value = naming.value_of(name, moment)
        except ConfigError:  # an expression of what is not known at this moment
            continue
        if value is not None:
            return value.number
    return None


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
