"""Set points: values to which a task wants to bring variables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from fmugym.expressions.language import Expression
from fmugym.task.section_entries import Derived, Limits, MemoryVariable, read_limits
from fmugym.task.series import Series, read_schedule
from fmugym.task.task_entries import Entry
from fmugym.task.task_keys import RAMP, SETPOINT, SINE, STEPS

__all__ = ["Deviation", "SetPoints", "Steps"]

_CURVES: Final = {
    "ramp": (RAMP, "{from} + ({to} - {from}) * clip((elapsed - {begin}) / {duration}, 0, 1)"),
    "sine": (SINE, "{mean} + {amplitude} * sin(2 * pi * elapsed / {period} + {phase})"),
}
"""The keys and formulas of set points that follow a curve."""

_UNLIMITED: Final = (-np.inf, np.inf)

_CHANNELS_OF_STEPS: Final = 20_000


@dataclass(frozen=True)
class Steps:
    """A set point that jumps to a new random value now and then.

    Attributes:
        entry: Entry of the task.
        limits: The values lie between these.
        every: Seconds from one value to the next.
        channel: Its number, from which its values follow.
    """

    entry: Entry
    limits: Limits
    every: float
    channel: int


class Deviation(NamedTuple):
    """Deviation of a variable from its set point.

    Attributes:
        setpoint: The name of the set point.
        of: The name of what should be there.
    """

    setpoint: str
    of: str


@dataclass
class SetPoints:
    """The set points of a task, in the forms that the rest of it knows, by name.

    Attributes:
        memory: Gets those that are constant or drawn, and the numbers of curves.
        series: Gets those that depend on the time of day.
        derived: Gets those that follow a curve or data, and the deviations.
        steps: Set points that jump.
        deviations: Deviations from set points, by name.
        brought: The names that curves and deviations bring with them.
    """

    memory: dict[str, MemoryVariable]
    series: dict[str, Series]
    derived: dict[str, Derived]
    steps: dict[str, Steps] = field(default_factory=dict)
    deviations: dict[str, Deviation] = field(default_factory=dict)
    brought: set[str] = field(default_factory=set)

    def add(self, entry: Entry) -> None:
        """Add a set point."""
        with entry.noting():
            given = (kind for kind in SETPOINT.one_of if kind in entry.value)
            self._add(entry, next(given, SETPOINT.short))
        of = entry.child("of")
        if of.value is not None:
            name, deviation = f"{entry.name}_error", Deviation(entry.name, of.value)
            self.deviations[name] = deviation
            self.brought.add(name)
            with of.placing():
                expression = Expression.parse(f"{deviation.setpoint} - {deviation.of}")
            self.derived[name] = Derived(of, expression, _UNLIMITED)

    def _add(self, entry: Entry, kind: str) -> None:
        match kind:
            case "value":
                value = entry.required("value").value
                self.memory[entry.name] = MemoryVariable(entry, value, None, read_limits(entry))
            case "schedule":
                self.series[entry.name] = read_schedule(entry)
            case "steps":
                steps, channel = entry.child("steps"), _CHANNELS_OF_STEPS + len(self.steps)
                low, high, every = (steps.required(key).value for key in STEPS.keys)
                self.steps[entry.name] = Steps(entry, (low, high), every, channel)
            case "data":
                with entry.child("data").placing():
                    name = Expression.parse(entry.value["data"])
                self.derived[entry.name] = Derived(entry, name, read_limits(entry))
            case _:
                self._add_curve(entry, kind)

    def _add_curve(self, entry: Entry, kind: str) -> None:
        """Add a curve over the time since the reset; its numbers may be drawn in each episode."""
        curve, (table, formula) = entry.child(kind), _CURVES[kind]
        numbers = {key: curve.required(key) for key in table.keys}
        names = {key: f"{entry.name}_{key}" for key in numbers}
        self.brought |= set(names.values())
        for key, one in numbers.items():
            self.memory[names[key]] = MemoryVariable(entry, one.value, None, _UNLIMITED)
        expression = Expression.parse(formula.format(**names))
        self.derived[entry.name] = Derived(entry, expression, read_limits(entry))
