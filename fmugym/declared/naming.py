"""What the names in the expressions of a task stand for: code that reads the environment."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from typing import Any, Final

import numpy as np

from fmugym.declared.declarations import BUILT_IN, Declarations
from fmugym.declared.entries import Entry
from fmugym.declared.expressions import Code, Expression, Names, code_of_number
from fmugym.declared.variables import Record, converted

__all__ = ["Moment", "Naming"]


class Moment(Enum):
    """When an expression is evaluated."""

    BEFORE = "before the FMU steps"
    AFTER = "after the FMU has stepped"
    JUDGED = "when it is known whether the task has ended"


_SECONDS_PER_HOUR: Final = 3600.0


class Naming:
    """Gives names their code.

    Args:
        declared: The task.
        time_step: Length of a step in seconds.

    Attributes:
        outputs: The names of the values in ``state``, in their order.
        monitors: The names of other values that are read from the FMU.
        constants: Tables that code reads by name.
    """

    def __init__(self, declared: Declarations, time_step: float) -> None:
        self._declared, self._time_step = declared, time_step
        self._open: list[str] = []
        self.constants: dict[str, Any] = {}
        self.outputs, self.monitors = self._read_names()

    def _read_names(self) -> tuple[list[str], list[str]]:
        """Observed variables come first, and next those whose previous values are needed."""
        declared, expressions = self._declared, self._declared.expressions
        observed = [name for _, name in declared.observed]
        previous = sorted(set().union(*(e.previous_names for e in expressions)))
        used = sorted(set().union(*(e.names for e in expressions)))
        wanted = dict.fromkeys(filter(declared.is_output, observed + previous))
        others = [name for name in used if declared.is_output(name) and name not in wanted]
        self._check_distinct([*wanted, *others])
        return (list(wanted), others) if wanted else (others, [])

    def _check_distinct(self, names: list[str]) -> None:
        """A step gives one value of each variable of the FMU."""
        seen: dict[str, str] = {}
        for name in names:
            record = self._declared.records[name]
            first = seen.setdefault(record.fmu_name, name)
            if first != name:
                raise record.entry.error(
                    f"{first!r} and {name!r} are both {record.fmu_name!r} of the FMU, which can be "
                    "read in one way only; write one as an expression of the other"
                )

    def code(self, entry: Entry, expression: Expression, moment: Moment) -> Code:
        """Make code of an expression.

        Raises:
            ConfigError: If it has unknown names, or names that have no value at this moment.
        """
        with entry.placing():
            return expression.code(self._names(moment))

    def _names(self, moment: Moment) -> Names:
        return Names(
            lambda name: self.code_of(name, moment),
            (lambda name: None) if moment is Moment.BEFORE else self._previous_code_of,
            self._known,
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
            return Code(f"env.variables[{name!r}]")
        if name in declared.derived:
            return self._code_of_derived(name, moment)
        record = declared.records.get(name)
        return None if record is None else Code(self._code_of_record(name, record, moment))

    def _built_in(self, name: str, moment: Moment) -> Code | None:
        match name:
            case "time":
                return Code("env.time")
            case "step":
                return Code("(env.step_count * 1.0)")
            case "done":
                return Code("env.done", True) if moment is Moment.JUDGED else None
            case "dt":
                return code_of_number(self._time_step)
        return code_of_number(self._time_step / _SECONDS_PER_HOUR)

    def _code_of_derived(self, name: str, moment: Moment) -> Code:
        derived = self._declared.derived[name]
        if name in self._open:
            raise derived.entry.error(f"{name!r} depends on itself")
        with self._opened(name):
            return self.code(derived.entry, derived.expression, moment)

    @contextmanager
    def _opened(self, name: str) -> Iterator[None]:
        self._open.append(name)
        yield
        self._open.pop()

    def _code_of_record(self, name: str, record: Record, moment: Moment) -> str:
        declared = self._declared
        if name in declared.parameters:
            return converted(record.conversion, f"env.parameters[{record.fmu_name!r}]")
        if record in declared.actions and (moment is Moment.BEFORE or record.variable is None):
            return self.action_code(record, "action")
        if name in declared.written:
            return converted(record.conversion, f"env.inputs[{declared.written.index(name)}]")
        place = [*self.outputs, *self.monitors].index(name)
        return converted(record.conversion, f"env._values[{place}]")

    def _previous_code_of(self, name: str) -> Code | None:
        declared, record = self._declared, self._declared.records.get(name)
        if record is not None and record in declared.actions:
            return Code(self.action_code(record, "previous_action"))
        if record is None or name not in self.outputs:
            return None
        place = self.outputs.index(name)
        return Code(converted(record.conversion, f"env.previous_state[{place}]"))

    def action_code(self, record: Record, attribute: str) -> str:
        """Code for an action in the unit of the task.

        Args:
            record: The variable that the agent writes.
            attribute: ``"action"`` or ``"previous_action"``.
        """
        place, is_one = self._declared.actions.index(record), len(self._declared.actions) == 1
        if not record.levels:
            return f"float64(env.{attribute}[{place}])"
        self.constants[f"levels_{place}"] = np.array(record.levels)
        element = f"env.{attribute}" if is_one else f"env.{attribute}[{place}]"
        return f"take(levels_{place}, {element})"
