"""Checks of Enumerations: each value that a task writes must be one of the items."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

from fmugym.archive.variable import Variable, checked_value
from fmugym.distributions import Choice

if TYPE_CHECKING:
    from fmugym.baselines import Controller
    from fmugym.declared.entries import Entry
    from fmugym.declared.section_entries import MemoryVariable
    from fmugym.declared.variables import TaskVariable
    from fmugym.expressions.value import Value

__all__ = ["check_controller", "check_levels", "check_written"]


def check_levels(variable: TaskVariable) -> None:
    """Check that the levels of an action are values that its input can have.

    Raises:
        ConfigError: If one is none: the input would get another one.
    """
    own = variable.in_fmu
    if own is None or own.kind == "real":
        return
    with variable.entry.child("levels").placing():
        for number in map(variable.conversion.inverse, variable.levels):
            whole = float(round(number))
            checked_value(own, whole if math.isclose(number, whole, rel_tol=1e-12) else number)


def check_controller(entry: Entry, variable: TaskVariable, controller: Controller) -> None:
    """Check the numbers that a controller of a warm-up writes to an Enumeration.

    Raises:
        ConfigError: If one is no item.
    """
    from fmugym.baselines import Constant, Hysteresis, Schedule

    if variable.in_fmu is None or variable.levels:  # of which it takes the nearest one
        return
    match controller:
        case Constant():
            _require_items(entry, variable.in_fmu, [controller.action])
        case Hysteresis():
            _require_items(
                entry, variable.in_fmu, [float(controller.below), float(controller.above)]
            )
        case Schedule():
            _require_items(entry, variable.in_fmu, controller.values)


def check_written(
    entry: Entry, variable: TaskVariable, value: Value, memory: Mapping[str, MemoryVariable]
) -> None:
    """Check the known values of an expression that is written to an Enumeration.

    Args:
        entry: Entry of the task.
        variable: Written variable.
        value: Its value.
        memory: Memory variables of the task, by name.

    Raises:
        ConfigError: If it writes a number that is no item.
    """
    if variable.fmu_variable.items:
        _require_items(entry, variable.fmu_variable, _known(value, memory))


def _require_items(entry: Entry, variable: Variable, values: Iterable[float]) -> None:
    for value in values if variable.items else ():
        with entry.placing():
            checked_value(variable, value)


def _known(value: Value, memory: Mapping[str, MemoryVariable]) -> Iterator[float]:
    """Values that are known to occur at one time or another."""
    graph, waiting = value.graph, [value.node]
    while waiting:
        node = graph.nodes[waiting.pop()]
        match node.kind, node.what:
            case "constant", _:
                yield float(node.number)
            case "where", _:
                waiting += node.operands[1:]
            case "cast", _:
                waiting += node.operands
            case "take", table:
                yield from graph.tables[table].tolist()
            case "interpolate", table:
                rows = graph.tables[table]
                yield from rows[len(rows) // 2 - 1 : -2].tolist()
            case "row", ("variables", str(name)) if name in memory:
                start = memory[name].start
                starts = start.values if isinstance(start, Choice) else (start,)
                yield from (one for one in starts if isinstance(one, int | float))
