"""Set points: what a task wants a variable to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.declared.entries import Entry
from fmugym.declared.expressions import Expression
from fmugym.declared.parts import Derived, Limits, Memory, read_limits, read_memory
from fmugym.declared.quantities import duration
from fmugym.declared.series import Series, read_schedule
from fmugym.declared.values import number, number_or_distribution

__all__ = ["SETPOINTS", "Deviation", "SetPoints", "Steps"]

SETPOINTS: Final = ("value", "schedule", "steps", "ramp", "sine", "data")
"""The kinds of set points."""

_CURVES: Final[Mapping[str, tuple[str, dict[str, float | None]]]] = {
    "ramp": (
        "{from} + ({to} - {from}) * clip((elapsed - {begin}) / {duration}, 0, 1)",
        {"from": None, "to": None, "begin": 0.0, "duration": None},
    ),
    "sine": (
        "{mean} + {amplitude} * sin(2 * pi * elapsed / {period} + {phase})",
        {"mean": 0.0, "amplitude": None, "period": None, "phase": 0.0},
    ),
}
"""Formulas of set points that follow a curve, and the defaults of their numbers."""

_TIMES_OF_CURVES: Final = ("begin", "duration", "period")

_CHANNELS_OF_STEPS: Final = 20_000


@dataclass(frozen=True)
class Steps:
    """A set point that jumps to a new random value now and then.

    Attributes:
        entry: Where it stands.
        limits: The values lie between these.
        every: Seconds from one value to the next.
        channel: Its number, from which its values follow.
    """

    entry: Entry
    limits: Limits
    every: float
    channel: int


class Deviation(NamedTuple):
    """How far something is from its set point.

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
        memory: Those that are constant or drawn, and the numbers of curves.
        series: Those that depend on the time of day.
        steps: Those that jump.
        derived: Those that follow a curve or data, and the deviations.
        deviations: What the names of deviations stand for.
    """

    memory: dict[str, Memory] = field(default_factory=dict)
    series: dict[str, Series] = field(default_factory=dict)
    steps: dict[str, Steps] = field(default_factory=dict)
    derived: dict[str, Derived] = field(default_factory=dict)
    deviations: dict[str, Deviation] = field(default_factory=dict)

    def add(self, entry: Entry) -> None:
        """Add a set point.

        Raises:
            ConfigError: If it is of no known kind, or lacks a number.
        """
        if not isinstance(entry.value, Mapping) or "distribution" in entry.value:
            self.memory[entry.name] = read_memory(entry)
            return
        table = entry.table((*SETPOINTS, "of", "min", "max"))
        kinds = [kind for kind in SETPOINTS if kind in table]
        if len(kinds) != 1:
            raise entry.error(f"give one of {', '.join(SETPOINTS)}")
        self._add(entry, kinds[0])
        if "of" in table:
            deviation = Deviation(entry.name, table["of"].text())
            self.deviations[f"{entry.name}_error"] = deviation
            with table["of"].placing():
                expression = Expression.parse(f"{deviation.setpoint} - {deviation.of}")
            limits = (-np.inf, np.inf)
            self.derived[f"{entry.name}_error"] = Derived(table["of"], expression, limits)

    def _add(self, entry: Entry, kind: str) -> None:
        match kind:
            case "value":
                start = number_or_distribution(entry.child("value"))
                self.memory[entry.name] = Memory(entry, start, None, read_limits(entry))
            case "schedule":
                self.series[entry.name] = read_schedule(entry.child("schedule"))
            case "steps":
                self.steps[entry.name] = _steps(entry, len(self.steps))
            case "data":
                name = Expression.parse(entry.child("data").text())
                self.derived[entry.name] = Derived(entry, name, read_limits(entry))
            case _:
                self._add_curve(entry, kind)

    def _add_curve(self, entry: Entry, kind: str) -> None:
        """Add a curve over the time since the reset; its numbers may be drawn in each episode."""
        name, (formula, defaults) = entry.name, _CURVES[kind]
        table = entry.child(kind).table(defaults)
        for key, default in defaults.items():
            if key not in table and default is None:
                raise entry.child(kind).error(f"the key {key!r} is missing")
            value = _of_curve(table[key]) if key in table else default
            self.memory[f"{name}_{key}"] = Memory(entry, value, None, (-np.inf, np.inf))
        names = {key: f"{name}_{key}" for key in defaults}
        expression = Expression.parse(formula.format(**names))
        self.derived[name] = Derived(entry, expression, read_limits(entry))


def _steps(entry: Entry, number_of_steps: int) -> Steps:
    table = entry.child("steps")
    table.table(("low", "high", "every"))
    limits = number(table.required("low")), number(table.required("high"))
    every = table.required("every").check(duration)
    if not limits[0] < limits[1]:
        raise table.error(f"low must be below high, got {limits[0]:g} and {limits[1]:g}")
    return Steps(entry, limits, every, _CHANNELS_OF_STEPS + number_of_steps)


def _of_curve(entry: Entry) -> Any:
    """A number of a curve, which may be a duration, or a distribution."""
    if entry.name in _TIMES_OF_CURVES and not isinstance(entry.value, Mapping):
        return entry.check(duration)
    return number_or_distribution(entry)
