"""What the names in the expressions of a task stand for: code that reads the environment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from typing import Any, Final

import numpy as np

from fmugym.declared.declarations import BUILT_IN, Declarations
from fmugym.declared.devices import NOISE
from fmugym.declared.entries import Entry
from fmugym.declared.expressions import Code, Expression, Names, code_of_number
from fmugym.declared.variables import Record, converted
from fmugym.errors import unknown_name
from fmugym.pool.spec import whole_number_of_steps
from fmugym.task.future import Lookup, Table

__all__ = ["CLOCK", "Moment", "Naming", "queue_name", "switch_names"]


class Moment(Enum):
    """When an expression is evaluated."""

    BEFORE = "before the FMU steps"
    AFTER = "after the FMU has stepped"
    JUDGED = "when it is known whether the task has ended"
    UPDATED = "when it is being found out whether the task has ended"
    SEEN = "when the agent observes, between two steps"
    FORECAST = "at a later time, which only functions of time know"


_OVER: Final = (Moment.AFTER, Moment.JUDGED, Moment.UPDATED)
"""The moments in which a value that holds for a while is that of the step that has just ended."""

CLOCK: Final = "clock"
"""The episode variable with the time of data at the beginning of an episode."""

_SECONDS_PER_HOUR: Final = 3600.0

_JUST: Final = 1e-6
"""Values that hold until the next one are looked up this part of a step after its beginning.

So the rounding of times does not matter.
"""


NO_NAMES: Final[Mapping[str, str]] = {}

_CHANNELS_OF_ACTUATORS: Final = 5_000
_LONGEST_DELAY: Final = 2000


def switch_names(record: Record) -> tuple[str, str]:
    """The episode variables that know whether an action is on, and for how many steps."""
    return f"{record.alias} is on", f"steps since {record.alias} was switched"


def queue_name(record: Record) -> str:
    """The episode variable with the latest choices for an action with a delay."""
    return f"choices of {record.alias}"


class Naming:
    """Gives names their code.

    Args:
        declared: The task.
        time_step: Length of a step in seconds.
        warm_steps: The steps of a warm-up with moving inputs.

    Attributes:
        outputs: The names of the values in ``state``, in their order.
        monitors: The names of other values that are read from the FMU.
        first_step: The step count after the first step, which may be one of the warm-up.
        constants: Tables that code reads by name.
        lookups: Those of the series that are read.
    """

    def __init__(self, declared: Declarations, time_step: float, warm_steps: int = 0) -> None:
        self._declared, self._time_step, self._warm_steps = declared, time_step, warm_steps
        self.first_step = 1 - warm_steps
        self._open: list[str] = []
        self._ahead = 0.0
        self._derived: dict[tuple[str, Moment, float], Code] = {}
        self.constants: dict[str, Any] = {}
        self.lookups: dict[str, Lookup] = {}
        self.outputs, self.monitors = self._read_names()

    def _read_names(self) -> tuple[list[str], list[str]]:
        """Observed variables come first, and next those whose previous values are needed."""
        declared, expressions = self._declared, self._declared.expressions
        observed = declared.measured
        previous = sorted(set().union(*(e.previous_names for e in expressions)))
        used = sorted(set().union(*(e.names for e in expressions)))
        wanted = dict.fromkeys(filter(declared.is_output, observed + previous))
        others = [name for name in used if declared.is_output(name) and name not in wanted]
        self._places = self._find_places([*wanted, *others])
        wanted = {name: None for name in wanted if self._is_first(name)}
        others = [name for name in others if self._is_first(name)]
        if not wanted and not others:
            raise declared.agent("observations").error("the task reads no variable of the FMU")
        return (list(wanted), others) if wanted else (others, [])

    def _find_places(self, names: list[str]) -> dict[str, int]:
        """Where the values of names are: several may stand for one variable of the FMU.

        Raises:
            ConfigError: If they are sampled in different ways: a step gives one value of each.
        """
        records, first = self._declared.records, dict[str, str]()
        for name in names:
            known = first.setdefault(records[name].fmu_name, name)
            if records[known].sample != records[name].sample:
                raise records[name].entry.error(
                    f"{known!r} and {name!r} are both {records[name].fmu_name!r} of the FMU, which "
                    "has one 'sample' only"
                )
        order = list(first.values())
        return {name: order.index(first[records[name].fmu_name]) for name in names}

    def _is_first(self, name: str) -> bool:
        """Whether no name before stands for the same variable of the FMU."""
        return name == next(n for n, p in self._places.items() if p == self._places[name])

    @property
    def read_names(self) -> list[str]:
        """The names of all values that are read from the FMU."""
        return list(self._places)

    def _is_output(self, name: str) -> bool:
        """Whether a name stands for one of the values in ``state``."""
        return self._places.get(name, len(self.outputs)) < len(self.outputs)

    def channel_of(self, name: str) -> int:
        """The number of the sensor of a value, from which its noise follows."""
        place = self._places[name]
        aliases = [n for n in self._places if not self._is_first(n)]
        return place if name not in aliases else len(self.outputs) + aliases.index(name)

    def code(
        self,
        entry: Entry,
        expression: Expression,
        moment: Moment,
        others: Mapping[str, str] = NO_NAMES,
    ) -> Code:
        """Make code of an expression.

        Args:
            entry: Where it stands.
            expression: The expression.
            moment: When it is evaluated.
            others: The code of more names.

        Raises:
            ConfigError: If it has unknown names, or names that have no value at this moment.
        """
        with entry.placing():
            return expression.code(self._names(moment, others))

    def _names(self, moment: Moment, others: Mapping[str, str]) -> Names:
        def find(name: str) -> Code | None:
            return Code(others[name]) if name in others else self.code_of(name, moment)

        return Names(
            find,
            (lambda name: None) if moment is Moment.BEFORE else self._previous_code_of,
            lambda: [*others, *self._known()],
        )

    def _known(self) -> list[str]:
        declared = self._declared
        return [*declared.own_names, *declared.parameters, *BUILT_IN, *declared.records.names()]

    def code_of(self, name: str, moment: Moment) -> Code | None:
        """The code of a name; None if there is no such name, or it has no value at this moment."""
        declared = self._declared
        if name in BUILT_IN:
            return self._built_in(name, moment)
        if name in declared.memory:
            return self._code_of_memory(name, moment)
        if name in declared.series:
            return Code(self._code_of_series(name, moment))
        if name in declared.steps:
            return Code(self._code_of_steps(name, moment))
        if name in declared.derived:
            return self._code_of_derived(name, moment)
        record = declared.records.get(name)
        return None if record is None else Code(self._code_of_record(name, record, moment))

    def forecast(self, entry: Entry, name: str, ahead: float) -> str:
        """Code for the value of a name at another time.

        Args:
            entry: Where the forecast stands.
            name: Something that depends on time only.
            ahead: Seconds from now; negative for the past.

        Raises:
            ConfigError: If it depends on more than time.
        """
        self._ahead = ahead
        try:
            code = self.code_of(name, Moment.FORECAST)
        finally:
            self._ahead = 0.0
        if code is None or code.value is not None:
            if name not in (known := self._known()):
                raise entry.error(unknown_name("name to forecast", name, known))
            raise entry.error(_no_forecast(name))
        return code.number.text

    def _code_of_memory(self, name: str, moment: Moment) -> Code:
        memory = self._declared.memory[name]
        if moment is Moment.FORECAST and memory.update is not None:
            raise memory.entry.error(_no_forecast(name))
        return Code(f"env.variables[{name!r}]")

    def _code_of_series(self, name: str, moment: Moment) -> str:
        """The value now. One that holds for a while is, after a step, that of the step."""
        series, shift = self._declared.series[name], self._ahead
        if series.is_stepped:
            shift += (_JUST - 1.0 if moment in _OVER else _JUST) * self._time_step
        now, shift = self.clock_code(), shift - series.start
        place = f"remainder(({now} + {shift!r}), {series.period!r})"
        if name not in self.lookups:
            table = Table(series.times, series.values)
            self.lookups[name] = self.constants[f"series_{name}"] = Lookup(
                len(self.lookups), series.start, series.period, series.is_stepped, table
            )
        return f"series_{name}({place})"

    def _code_of_steps(self, name: str, moment: Moment) -> str:
        """The random value now; after a step, that of the step."""
        steps = self._declared.steps[name]
        count = whole_number_of_steps(steps.every, self._time_step)
        if not count:
            raise steps.entry.error(
                f"{steps.every:g} s is no multiple of the time step of {self._time_step:g} s"
            )
        shift = round(self._ahead / self._time_step) - (moment in _OVER)
        place = f"fn_floor((fn_max((env.step_count + {float(shift)!r}), 0.0) / {float(count)!r}))"
        chance = f"chance(env.variables[{NOISE!r}], {place}, {steps.channel})"
        low, high = steps.limits
        return f"({low!r} + {high - low!r} * {chance})"

    def _built_in(self, name: str, moment: Moment) -> Code | None:
        match name:
            case "time":
                return Code(f"(env.time + {self._ahead!r})" if self._ahead else "env.time")
            case "clock":
                return Code(f"({self.clock_code()} + {self._ahead!r})")
            case "elapsed":
                return Code(f"(env.step_count * {self._time_step!r} + {self._ahead!r})")
            case "step":
                return Code(f"(env.step_count + {self._ahead / self._time_step!r})")
            case "done":
                return self._done(moment)
            case "dt":
                return code_of_number(self._time_step)
        return code_of_number(self._time_step / _SECONDS_PER_HOUR)

    def clock_code(self) -> str:
        """Code for the time of data now; that of the FMU if the task sets no other clock."""
        if self._declared.root.child("clock").value is None:
            return "env.time"
        return f"(env.variables[{CLOCK!r}] + env.step_count * {self._time_step!r})"

    def _done(self, moment: Moment) -> Code | None:
        if moment is Moment.JUDGED:
            return Code("env.done", True)
        if moment is not Moment.UPDATED:
            return None
        flags, entry = self._declared.flags, self._declared.root.child("terminated")
        if "terminated" not in flags:
            return Code("False", True, False)
        return self.code(entry, flags["terminated"], Moment.AFTER)

    def _code_of_derived(self, name: str, moment: Moment) -> Code:
        derived, key = self._declared.derived[name], (name, moment, self._ahead)
        if name in self._open:
            raise derived.entry.error(f"{name!r} depends on itself")
        if key not in self._derived:  # many may read it
            with self._opened(name):
                self._derived[key] = self.code(derived.entry, derived.expression, moment)
        return self._derived[key]

    @contextmanager
    def _opened(self, name: str) -> Iterator[None]:
        self._open.append(name)
        try:
            yield
        finally:
            self._open.pop()

    def _code_of_record(self, name: str, record: Record, moment: Moment) -> str:
        declared = self._declared
        if moment is Moment.FORECAST:
            raise record.entry.error(_no_forecast(name))
        if record in declared.actions and record.variable is None:
            return self.action_code(record, "action")
        if record in declared.actions and moment is Moment.BEFORE:
            return self.input_code(record)
        if name in declared.written:
            return converted(record.conversion, f"env.inputs[{declared.written.index(name)}]")
        if name in declared.parameters:
            if record.variable is not None and record.variable.kind == "string":
                raise record.entry.error(f"{name!r} is a String: expressions have numbers only")
            return converted(record.conversion, f"env.parameters[{record.fmu_name!r}]")
        place = self._places[name]
        return converted(record.conversion, f"env.inside.readings.values[{place}]")

    def _previous_code_of(self, name: str) -> Code | None:
        declared, record = self._declared, self._declared.records.get(name)
        if record is not None and record in declared.actions:
            is_known = record.is_direct
            return Code(self.action_code(record, "previous_action")) if is_known else None
        if record is None or not self._is_output(name):
            return None
        place = self._places[name]
        return Code(converted(record.conversion, f"env.previous_state[{place}]"))

    def action_code(self, record: Record, attribute: str) -> str:
        """Code for an action in the unit of the task.

        Args:
            record: The variable that the agent writes.
            attribute: ``"action"`` or ``"previous_action"``.
        """
        declared = self._declared
        place, is_one = declared.actions.index(record), len(declared.actions) == 1
        if declared.is_physical or not record.levels:
            element = f"float64(env.{attribute}[{place}])"
            if record.levels:
                return self._nearest_level(record, element)
            return self._rescaled(record, element) if declared.rescales else element
        self.constants[f"levels_{place}"] = np.array(record.levels)
        element = f"env.{attribute}" if is_one else f"env.{attribute}[{place}]"
        return f"take(levels_{place}, {element})"

    def input_code(self, record: Record) -> str:
        """Code for the value that an action gives an input, in the unit of the task."""
        chosen = self.action_code(record, "action")
        if record.is_direct:
            return chosen
        now = self.present_code(record)
        if record.device.delay:
            chosen = self._late(record)
        if record.delta:
            chosen = self._changed(record, chosen, now)
        device, channel = record.device, _CHANNELS_OF_ACTUATORS + self._place_of(record)
        chosen = device.distorted(chosen, "env.step_count", channel)
        chosen = device.following(chosen, now, "env.step_count", channel, self._time_step)
        if record.is_switched:
            chosen = f"where({self.blocked_code(record, chosen)}, {now}, {chosen})"
        return chosen

    def _changed(self, record: Record, chosen: str, now: str) -> str:
        """Code for an input after a change; in the physical form, towards the chosen value."""
        value = f"({now} + {chosen})"
        if self._declared.is_physical:
            value = f"fn_clip({chosen}, ({now} - {record.delta!r}), ({now} + {record.delta!r}))"
        return f"fn_clip({value}, {record.low!r}, {record.high!r})"

    def _place_of(self, record: Record) -> int:
        return self._declared.actions.index(record)

    def delay_of(self, record: Record) -> int:
        """By how many steps a sensor or an actuator is late.

        Raises:
            ConfigError: If the delay is no multiple of the time step.
        """
        delay = record.device.delay
        count = whole_number_of_steps(delay, self._time_step) if delay else 0
        if delay and (not count or count > _LONGEST_DELAY):
            raise record.entry.child("delay").error(
                f"{delay:g} s is no multiple of the step of {self._time_step:g} s, or more than "
                f"{_LONGEST_DELAY} steps"
            )
        return count or 0

    def _late(self, record: Record) -> str:
        """Code for what the agent chose some steps ago."""
        count, queue = self.delay_of(record), f"env.variables[{queue_name(record)!r}]"
        first = float(count - self._warm_steps)
        return (
            f"where((env.step_count < {first!r}), {self.start_code(record)}, {queue}[{count - 1}])"
        )

    def start_code(self, record: Record) -> str:
        """Code for what counts as chosen before the first action; no change for changes."""
        if record.delta and not self._declared.is_physical:
            return "(env.step_count * 0.0)"
        return self._start_of_input(record)

    def _start_of_input(self, record: Record) -> str:
        if record.variable is None:
            return "(env.step_count * 0.0)"
        if record.alias in self._declared.parameters:
            start = f"env.parameters[{record.fmu_name!r}]"
        else:
            start = f"(env.step_count * 0.0 + {record.variable.start_number!r})"
        return converted(record.conversion, start)

    def present_code(self, record: Record) -> str:
        """Code for the value that an input has now, in the unit of the task."""
        place = self._declared.written.index(record.alias)
        return converted(record.conversion, f"env.inputs[{place}]")

    def blocked_code(self, record: Record, chosen: str) -> str:
        """Code for whether it is too early to switch to a value.

        Args:
            record: A variable with a least time on or off.
            chosen: Code for the value.
        """
        state, since = (f"env.variables[{name!r}]" for name in switch_names(record))
        on, off = (np.ceil(t / self._time_step - _JUST) for t in (record.min_on, record.min_off))
        stays_on = f"(({state} > 0.5) & ({chosen} == 0.0) & ({since} < {float(on)!r}))"
        stays_off = f"(({state} < 0.5) & ({chosen} != 0.0) & ({since} < {float(off)!r}))"
        return f"({stays_on} | {stays_off})"

    def switch_codes(self, record: Record) -> tuple[str, str]:
        """Code for the new values of the variables that ``switch_names`` names."""
        state, since = (f"env.variables[{name!r}]" for name in switch_names(record))
        is_on = f"((env.inputs[{self._declared.written.index(record.alias)}] != 0.0) * 1.0)"
        return is_on, f"where({is_on} == {state}, ({since} + 1.0), 1.0)"

    def _rescaled(self, record: Record, element: str) -> str:
        """Code that turns an action from -1 to 1 into one from the lowest to the highest value."""
        if record.delta:
            return f"({record.delta!r} * {element})"
        middle, half = (record.low + record.high) / 2, (record.high - record.low) / 2
        return f"({middle!r} + {half!r} * {element})"

    def _nearest_level(self, record: Record, element: str) -> str:
        """Code for the level that is nearest to a value, the lower one of two."""
        levels = np.sort(record.levels)
        table = f"levels_{self._place_of(record)}"
        self.constants[table] = levels
        middles = ((levels[1:] + levels[:-1]) / 2).tolist()
        return f"take({table}, {' + '.join(f'({element} > {m!r}) * 1' for m in middles)})"

    def kept(self, name: str) -> tuple[str, str] | None:
        """Code for what a history adds to a name's values in each step.

        Returns:
            Code for the value to add, and for the older values in the first step; None if there is
            no history of this name.
        """
        declared, record = self._declared, self._declared.records.get(name)
        if record is None or not (record in declared.actions or self._is_output(name)):
            return None
        if record not in declared.actions:
            before = self._previous_code_of(name)
            return None if before is None else (before.text, before.text)
        now = self._code_of_record(name, record, Moment.AFTER)
        if record.variable is None:
            return now, self.action_code(record, "previous_action")
        return now, self._start_of_input(record)


def _no_forecast(name: str) -> str:
    return f"there is no forecast of {name!r}: it needs data, a set point or an expression of time"
