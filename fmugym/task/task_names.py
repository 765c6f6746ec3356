"""Names in the expressions of a task, and the values of the environment that they read."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from enum import Enum
from functools import reduce
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.environment.forecasts import Lookup, Span, distance_of
from fmugym.errors import ConfigError, ConsequenceError, unknown_name
from fmugym.expressions.functions import clip, maximum
from fmugym.expressions.graph import Graph, Value, where
from fmugym.expressions.language import Expression, Names
from fmugym.fmi.variable import Variable
from fmugym.task.declarations import BUILT_IN, Declarations
from fmugym.task.sensors import chance_in
from fmugym.task.series import Series
from fmugym.task.task_entries import Entry, nearest_steps, steps_in
from fmugym.task.task_variables import TaskVariable

__all__ = ["CLOCK", "Moment", "Naming", "queue_name", "switch_names"]


class Moment(Enum):
    """Moment at which an expression is evaluated."""

    BEFORE = "before the FMU steps"
    AFTER = "after the FMU has stepped"
    JUDGED = "when it is known whether the task has ended"
    UPDATED = "when it is being found out whether the task has ended"
    SEEN = "when the agent observes, between two steps"
    FORECAST = "at a later time, which only functions of time know"


_OVER: Final = (Moment.AFTER, Moment.JUDGED, Moment.UPDATED)
"""Moments after a step, at which a value that holds is still the value of that step."""

CLOCK: Final = "clock"
"""The episode variable with the time of data at the beginning of an episode."""

_SECONDS_PER_HOUR: Final = 3600.0

_JUST: Final = 1e-6
"""Values that hold until the next one are looked up this part of a step after its beginning.

So the rounding of times does not matter.
"""


_NO_NAMES: Final[Mapping[str, Value]] = {}

_CHANNELS_OF_ACTUATORS: Final = 5_000
_LONGEST_DELAY: Final = 2000


def switch_names(variable: TaskVariable) -> tuple[str, str]:
    """Names of the episode variables for whether an action is on, and since how many steps."""
    return f"{variable.alias} is on", f"steps since {variable.alias} was switched"


def queue_name(variable: TaskVariable) -> str:
    """The episode variable with the latest choices for an action with a delay."""
    return f"choices of {variable.alias}"


class Naming:
    """Gives names their values.

    Args:
        declared: The task.
        time_step: Length of a step in seconds.
        warm_steps: The steps of a warm-up with moving inputs.

    Attributes:
        declared, time_step, warm_steps: As given.
        graph: Has everything that the task computes.
        outputs: The names of the values in ``state``, in their order.
        monitors: The names of other values that are read from the FMU.
        first_step: The step count after the first step, which may be one of the warm-up.
        lookups: The series that are read, by name.
    """

    def __init__(self, declared: Declarations, time_step: float, warm_steps: int = 0) -> None:
        self.declared, self.time_step, self.warm_steps = declared, time_step, warm_steps
        self.first_step = 1 - warm_steps
        self._ahead = 0.0
        self._values: dict[tuple[str, Moment, float], Value] = {}
        self._derived: dict[tuple[str, Moment, float], Value | None] = {}
        self.graph = Graph()
        self.lookups: dict[str, Lookup] = {}
        self.outputs, self.monitors = self._read_names()

    def _read_names(self) -> tuple[list[str], list[str]]:
        """List observed variables first, and then variables whose previous values are needed."""
        declared, expressions = self.declared, self.declared.expressions
        observed = declared.measured
        previous = sorted(set().union(*(e.previous_names for e in expressions)))
        used = sorted(set().union(*(e.names for e in expressions)))
        wanted = set(observed + previous)
        names = filter(declared.is_output, dict.fromkeys([*observed, *previous, *used]))
        self._places = self._find_places(list(names))
        outputs = [name for name in self._firsts if name in wanted]
        if not self._firsts:
            text = "the task reads no variable of the FMU"
            is_known = declared.root.mistakes.explain(())  # by any mistake
            raise (
                ConsequenceError(text)
                if is_known
                else declared.agent_entry("observations").error(text)
            )
        return (outputs, self._firsts[len(outputs) :]) if outputs else (self._firsts, [])

    def _find_places(self, names: list[str]) -> dict[str, int]:
        """Find the places of the values; several names may share one variable of the FMU.

        ``_firsts`` are the names that come first for their variables. Several must be sampled in
        one way: a step gives one value of each.
        """
        variables, first = self.declared.variables, dict[str, str]()
        originals: dict[str, Variable] = {}
        for name in names:
            with variables[name].entry.noting():
                if variables[name].in_fmu is None and not self.declared.knows_actions:
                    raise ConsequenceError(f"{name!r} may be an action")
                originals[name] = variables[name].fmu_variable
        for name, original in originals.items():
            known = first.setdefault(original.name, name)
            if originals[known].sampling != original.sampling:
                entry = variables[name].entry
                text = f"{known!r} and {name!r} are both {original.name!r} of the FMU, which has "
                entry.note(entry.error(f"{text}one 'sample' only"))
        self._firsts = list(first.values())
        return {name: self._firsts.index(first[one.name]) for name, one in originals.items()}

    @property
    def read_names(self) -> list[str]:
        """The names of all values that are read from the FMU."""
        return list(self._places)

    def _is_output(self, name: str) -> bool:
        """Whether the value of a name is in ``state``."""
        return self._places.get(name, len(self.outputs)) < len(self.outputs)

    def channel_of(self, name: str) -> int:
        """The number of the sensor of a value, from which its noise follows."""
        place = self._places[name]
        aliases = [n for n in self._places if n not in self._firsts]
        return place if name not in aliases else len(self.outputs) + aliases.index(name)

    def read(self, name: str, *keys: str | int, dtype: npt.DTypeLike | None = None) -> Value:
        """A value that an episode has; see ``Value.read``."""
        return Value.read(self.graph, name, *keys, dtype=dtype)

    def constant(self, number: float | bool) -> Value:
        """A value that is the same everywhere."""
        return Value.of(self.graph, number)

    @property
    def step_count(self) -> Value:
        """The steps since the reset."""
        return self.read("step_count")

    def value(
        self,
        entry: Entry,
        expression: Expression,
        moment: Moment,
        others: Mapping[str, Value] = _NO_NAMES,
    ) -> Value:
        """Evaluate an expression.

        Args:
            entry: Entry of the task.
            expression: The expression.
            moment: When it is evaluated.
            others: The values of more names.

        Raises:
            ConfigError: If it has unknown names, or names that have no value at this moment.
        """
        key = expression.text, moment, self._ahead
        if others or key not in self._values:
            with entry.placing():
                value = expression.value(self._names(moment, others))
            if others:
                return value
            self._values[key] = value
        return self._values[key]

    def _names(self, moment: Moment, others: Mapping[str, Value]) -> Names:
        def find(name: str) -> Value | None:
            if name in others:
                return others[name]
            value = self.value_of(name, moment)
            if value is None and name in BUILT_IN:
                places = "'reward', 'costs', 'kpis' and 'truncated'"
                raise ConfigError(f"{name!r} is known in {places} only")
            if value is None:
                self.declared.variables.require_unhidden(name)
            return value

        return Names(
            self.graph,
            find,
            (lambda name: None) if moment is Moment.BEFORE else self._previous_value_of,
            lambda: [*others, *self._known()],
        )

    def _known(self) -> list[str]:
        declared = self.declared
        own = [*declared.own_names, *declared.parameters, *BUILT_IN]
        return [*own, *declared.variables.names()]

    def value_of(self, name: str, moment: Moment) -> Value | None:
        """The value of a name; None if there is no such name, or it has none at this moment."""
        declared = self.declared
        if name in BUILT_IN:
            return self._built_in(name, moment)
        if name in declared.memory:
            return self._value_of_memory(name, moment)
        if name in declared.series:
            return self._value_of_series(name, moment)
        if name in declared.steps:
            return self._value_of_steps(name, moment)
        if name in declared.derived:
            return self._value_of_derived(name, moment)
        if declared.is_own(name):
            raise ConsequenceError(f"{name!r} has a mistake where it is declared")
        variable = declared.variables.get(name)
        return None if variable is None else self._value_of_variable(name, variable, moment)

    def forecast(self, entry: Entry, name: str, ahead: float) -> Value:
        """The value of a name at another time.

        Args:
            entry: Entry of the task.
            name: Something that depends on time only.
            ahead: Seconds from now; negative for the past.

        Raises:
            ConfigError: If it depends on more than time.
        """
        self._ahead = ahead
        try:
            value = self.value_of(name, Moment.FORECAST)
        finally:
            self._ahead = 0.0
        if value is None or value.constant is not None:
            if value is None:
                self.declared.variables.require_unhidden(name)
            if name not in (known := self._known()):
                raise entry.error(unknown_name("name to forecast", name, known))
            raise entry.error(_no_forecast(name))
        return value.number

    def _value_of_memory(self, name: str, moment: Moment) -> Value:
        memory = self.declared.memory[name]
        if moment is Moment.FORECAST and memory.update is not None:
            raise memory.entry.error(_no_forecast(name))
        return self.read("variables", name)

    def _value_of_series(self, name: str, moment: Moment) -> Value:
        """Present value of a series; after a step, a value that holds is that of the step."""
        series, shift = self.declared.series[name], self._ahead
        lookup = self._lookup_of(name, series)
        distance = distance_of(lookup.spans)
        if series.is_stepped:
            shift += (_JUST - 1.0 if moment in _OVER else _JUST) * self.time_step
            shift += 4.0 * float(np.spacing(distance * len(lookup.spans)))  # places round more
        if not series.variable:
            place = (self.clock + (shift - series.start)) % series.period
            return place.interpolated(lookup.key)
        number = self.read("variables", series.variable).cast(np.int64)
        start, period = (
            self._of_file(f"{what} of {name}", values, number)
            for what, values in zip(Span._fields, zip(*lookup.spans, strict=True), strict=True)
        )
        place = (self.clock + (shift - start)) % period + number * distance
        return place.interpolated(lookup.key)

    def _lookup_of(self, name: str, series: Series) -> Lookup:
        """The table of a series, which the graph gets if it has none yet."""
        if name not in self.lookups:
            table, points = f"series {name}", series.points
            numbered = [float(len(self.lookups))]  # for nobody looks to the left
            self.graph.tables[table] = np.concatenate([points, numbered, points[-1:]])
            self.lookups[name] = Lookup(
                self.graph.tables, table, series.spans, series.is_stepped, series.variable
            )
        return self.lookups[name]

    def _of_file(self, table: str, values: Sequence[float], number: Value) -> Value | float:
        """The number that belongs to the episode's file."""
        if len(set(values)) == 1:
            return values[0]
        self.graph.tables[table] = np.array(values)
        return number.taken(table)

    def _value_of_steps(self, name: str, moment: Moment) -> Value:
        """Random value of this step, also after the step."""
        steps = self.declared.steps[name]
        count = steps_in(steps.entry, steps.every, self.time_step)
        shift = nearest_steps(self._ahead, self.time_step) - (moment in _OVER)
        passed = maximum(self.step_count + float(shift), 0.0)
        low, high = steps.limits
        return low + (high - low) * chance_in(np.floor(passed / float(count)), steps.channel)

    def _built_in(self, name: str, moment: Moment) -> Value | None:
        match name:
            case "time":
                return self.read("time") + self._ahead if self._ahead else self.read("time")
            case "clock":
                return self.clock + self._ahead
            case "elapsed":
                return self.step_count * self.time_step + self._ahead
            case "step":
                return self.step_count + self._ahead / self.time_step
            case "done":
                return self._done(moment)
            case "dt":
                return self.constant(self.time_step)
        return self.constant(self.time_step / _SECONDS_PER_HOUR)

    @property
    def clock(self) -> Value:
        """Present time of data; the FMU's time if the task sets no other clock."""
        if self.declared.root.child("clock").value is None:
            return self.read("time")
        return self.read("variables", CLOCK) + self.step_count * self.time_step

    def _done(self, moment: Moment) -> Value | None:
        if moment is Moment.JUDGED:
            return self.read("done")
        if moment is not Moment.UPDATED:
            return None
        flags, entry = self.declared.flags, self.declared.root.child("terminated")
        if "terminated" not in flags:
            return self.constant(False)
        return self.value(entry, flags["terminated"], Moment.AFTER)

    def _value_of_derived(self, name: str, moment: Moment) -> Value:
        declared, key = self.declared.derived, (name, moment, self._ahead)
        for one in () if key in self._derived else self._needed_for(name, moment):
            entry, expression = declared[one].entry, declared[one].expression
            with entry.noting():
                self._derived[one, moment, self._ahead] = self.value(entry, expression, moment)
        value = self._derived[key]
        if value is None:
            raise ConsequenceError(f"{name!r} has a mistake where it is declared")
        return value

    def _needed_for(self, name: str, moment: Moment) -> list[str]:
        """A named expression after the ones that it reads, without names that count as known.

        From now on they all count so. Thousands may read each other in a row.
        """
        declared, order, path = self.declared.derived, list[str](), set[str]()
        waiting = [(name, False)]
        while waiting:
            one, is_done = waiting.pop()
            key = one, moment, self._ahead
            if is_done:
                order.append(one)
                path.discard(one)
            elif one in path:
                with declared[one].entry.noting():
                    raise ConfigError(f"{one!r} depends on itself")
            elif key not in self._derived:
                self._derived[key] = None
                path.add(one)
                waiting.append((one, True))
                names = sorted(declared[one].expression.names & declared.keys(), reverse=True)
                waiting += ((other, False) for other in names)
        return order

    def _value_of_variable(self, name: str, variable: TaskVariable, moment: Moment) -> Value:
        declared = self.declared
        if moment is Moment.FORECAST:
            raise variable.entry.error(_no_forecast(name))
        if variable in declared.actions and variable.in_fmu is None:
            return self.action(variable, "action")
        if variable in declared.actions and moment is Moment.BEFORE:
            return self.input(variable)
        if name in declared.written:
            return self.present(variable)
        if name in declared.parameters:
            if variable.in_fmu is not None and variable.in_fmu.kind == "string":
                raise variable.entry.error(f"{name!r} is a String: expressions have numbers only")
            return variable.conversion(self.read("parameters", variable.fmu_variable.name))
        if name not in self._places:
            raise ConsequenceError(f"{name!r} is no variable of the FMU")
        value = self.read("outputs", self._places[name])
        return variable.conversion(value)

    def _previous_value_of(self, name: str) -> Value | None:
        declared, variable = self.declared, self.declared.variables.get(name)
        if variable is not None and variable in declared.actions:
            return self.action(variable, "previous_action") if variable.is_direct else None
        if variable is None or not self._is_output(name):
            if not declared.knows_actions:
                raise ConsequenceError(f"{name!r} may be an action")
            return None
        return variable.conversion(self.read("previous_outputs", self._places[name]))

    def action(self, variable: TaskVariable, attribute: str) -> Value:
        """An action in the unit of the task.

        Args:
            variable: The variable that the agent writes.
            attribute: ``"action"`` or ``"previous_action"``.
        """
        declared, place = self.declared, self._place_of(variable)
        if declared.is_physical or not declared.are_choices:
            element = self.read(attribute, place, dtype=np.float32).cast(np.float64)
            if variable.levels:
                return self._level(variable, element)
            return self._rescaled(variable, element) if declared.rescales else element
        keys = [] if len(declared.actions) == 1 else [place]
        levels = self._table_of_levels(variable, np.array(variable.levels))
        return self.read(attribute, *keys, dtype=np.int64).taken(levels)

    def _table_of_levels(self, variable: TaskVariable, levels: npt.NDArray[Any]) -> str:
        name = f"levels of {variable.alias}"
        self.graph.tables[name] = levels
        return name

    def input(self, variable: TaskVariable) -> Value:
        """The value that an action gives an input, in the unit of the task."""
        chosen = self.action(variable, "action")
        if variable.is_direct:
            return chosen
        now = self.present(variable)
        if variable.device.delay:
            chosen = self._late(variable)
        if variable.delta:
            chosen = self._changed(variable, chosen, now)
        device, channel = variable.device, _CHANNELS_OF_ACTUATORS + self._place_of(variable)
        chosen = device.distorted(chosen, self.step_count, channel)
        chosen = device.following(chosen, now, self.step_count, channel, self.time_step)
        if variable.is_switched:
            chosen = where(self.blocked(variable, chosen), now, chosen)
        return chosen

    def _changed(self, variable: TaskVariable, chosen: Value, now: Value) -> Value:
        """An input after a change; in the physical form, towards the chosen value."""
        value = now + chosen
        if self.declared.is_physical:
            value = clip(chosen, now - variable.delta, now + variable.delta)
        limited: Value = clip(value, *variable.limits)
        return limited

    def _place_of(self, variable: TaskVariable) -> int:
        return self.declared.actions.index(variable)

    def delay_of(self, variable: TaskVariable) -> int:
        """Delay of a sensor or an actuator, in steps.

        Raises:
            ConfigError: If the delay is no multiple of the time step.
        """
        delay, entry = variable.device.delay, variable.entry.child("delay")
        return steps_in(entry, delay, self.time_step, _LONGEST_DELAY) if delay else 0

    def _late(self, variable: TaskVariable) -> Value:
        """Action that the agent chose some steps ago."""
        count = self.delay_of(variable)
        queued = self.read("variables", queue_name(variable), count - 1)
        is_first = self.step_count < float(count - self.warm_steps)
        return where(is_first, self.start(variable), queued)

    def start(self, variable: TaskVariable) -> Value:
        """Value that counts as chosen before the first action; 0 for changes."""
        if variable.delta and not self.declared.is_physical:
            return self.step_count * 0.0
        return self._start_of_input(variable)

    def _start_of_input(self, variable: TaskVariable) -> Value:
        if variable.in_fmu is None:
            return self.step_count * 0.0
        if variable.alias in self.declared.parameters:
            start = self.read("parameters", variable.fmu_variable.name)
        else:
            start = self.step_count * 0.0 + variable.in_fmu.start_number
        return variable.conversion(start)

    def present(self, variable: TaskVariable) -> Value:
        """The value that an input has now, in the unit of the task."""
        return variable.conversion(self._written(variable))

    def _written(self, variable: TaskVariable) -> Value:
        return self.read("inputs", self.declared.written.index(variable.alias))

    def blocked(self, variable: TaskVariable, chosen: Value) -> Value:
        """Whether it is too early to switch to a value.

        Args:
            variable: A variable with a least time on or off.
            chosen: The value.
        """
        state, since = (self.read("variables", name) for name in switch_names(variable))
        on, off = (np.ceil(t / self.time_step - _JUST) for t in (variable.min_on, variable.min_off))
        stays_on = (state > 0.5) & (chosen == 0.0) & (since < float(on))
        stays_off = (state < 0.5) & (chosen != 0.0) & (since < float(off))
        return stays_on | stays_off

    def switched(self, variable: TaskVariable) -> tuple[Value, Value]:
        """The new values of the variables that ``switch_names`` names."""
        state, since = (self.read("variables", name) for name in switch_names(variable))
        is_on = (self._written(variable) != 0.0) * 1.0
        return is_on, where(is_on == state, since + 1.0, 1.0)

    def _rescaled(self, variable: TaskVariable, element: Value) -> Value:
        """Turn an action from -1 to 1 into one from the lowest to the highest value."""
        low, high = variable.chosen
        value = (high - low) / 2 * element
        return value if variable.delta else (low + high) / 2 + value

    def _level(self, variable: TaskVariable, element: Value) -> Value:
        """The level that a number stands for.

        In the physical form that is the nearest one, the lower one of two. For an agent, the range
        of the number has equal parts, one for each level.
        """
        levels = np.sort(variable.levels)
        ends = (levels[1:] + levels[:-1]) / 2
        if not self.declared.is_physical:
            ends = np.linspace(*self.declared.range_of(variable), len(levels) + 1)[1:-1]
        place: Value = reduce(operator.add, [(element > end) * 1 for end in ends.tolist()])
        return place.taken(self._table_of_levels(variable, levels))

    def kept(self, name: str) -> tuple[Value, Value] | None:
        """Values of a name that a history keeps in each step.

        Returns:
            The value to add, and the older values in the first step; None if there is no history of
            this name.
        """
        declared, variable = self.declared, self.declared.variables.get(name)
        if variable is None or not (variable in declared.actions or self._is_output(name)):
            return None
        if variable not in declared.actions:
            before = self._previous_value_of(name)
            return None if before is None else (before, before)
        now = self._value_of_variable(name, variable, Moment.AFTER)
        if variable.in_fmu is None:
            return now, self.action(variable, "previous_action")
        return now, self._start_of_input(variable)


def _no_forecast(name: str) -> str:
    return f"there is no forecast of {name!r}: it needs data, a set point or an expression of time"
