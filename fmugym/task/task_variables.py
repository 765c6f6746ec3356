"""Variables of a task, each with its place in the file and its variable of the FMU.

Each value that a task writes to an Enumeration must be one of its items.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fmugym.checks import Spellings, normal_form
from fmugym.environment.distributions import Choice, LogUniform, Normal, Uniform, is_distribution
from fmugym.environment.fmu_variables import check_input, check_output, checked, spread, within
from fmugym.errors import ConfigError, ConsequenceError, shown, unknown_name
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.units import IDENTITY, Conversion, conversion_of
from fmugym.fmi.variable import Variable, checked_value
from fmugym.task.section_entries import Limits, read_limits
from fmugym.task.sensors import IDEAL, Device, read_device
from fmugym.task.task_entries import Entry, number_or_distribution

if TYPE_CHECKING:
    from fmugym.control import Controller
    from fmugym.expressions.graph import Value
    from fmugym.task.section_entries import MemoryVariable

__all__ = [
    "NAMING",
    "TaskVariable",
    "TaskVariables",
    "check_items_of_controller",
    "check_levels",
    "check_written",
    "declared_start",
    "has_fmu_values",
]

_PLAIN: Final = ("levels", "delta", "min_on", "min_off")
"""Keys of a variable that are attributes of it as they are."""

NAMING: Final = ("variables", "memory", "expressions", "data", "setpoints")
"""The sections whose keys are names in expressions."""


@dataclass(frozen=True)
class TaskVariable:
    """A variable as a task sees it.

    Attributes:
        alias: Its name in the task.
        entry: Entry that declares or first uses the variable.
        in_fmu: The FMU's variable, with the bounds and the sampling of the task; None for an
            action that only expressions read.
        unit: The unit of the task; None if neither the task nor the FMU gives one.
        conversion: From the FMU's unit to that of the task.
        limits: Limits in the unit of the task; infinite where there are none.
        nominal: The usual size of its values; None if neither the task nor the FMU says it.
        levels: The values that an action chooses from; empty for a continuous one.
        delta: The largest change in a step, which is what the agent chooses; 0 if it chooses the
            value itself.
        device: The sensor of what the agent observes, or the actuator of an action.
        min_on, min_off: How many seconds an action stays other than 0, and stays 0, at least.
    """

    alias: str
    entry: Entry
    in_fmu: Variable | None
    unit: str | None
    conversion: Conversion
    limits: Limits
    levels: tuple[float, ...] = ()
    nominal: float | None = None
    delta: float = 0.0
    min_on: float = 0.0
    min_off: float = 0.0
    device: Device = IDEAL

    @property
    def is_direct(self) -> bool:
        """Whether an action reaches the FMU as the agent has chosen it."""
        return not self.delta and self.device.is_ideal and not self.is_switched

    @property
    def is_switched(self) -> bool:
        """Whether there is a least time on or off."""
        return self.min_on > 0 or self.min_off > 0

    @property
    def range(self) -> Limits:
        """The lowest and the highest value of an action."""
        return (min(self.levels), max(self.levels)) if self.levels else self.limits

    @property
    def chosen(self) -> Limits:
        """The lowest and the highest value, or change of it, that an agent chooses."""
        return (-self.delta, self.delta) if self.delta else self.range

    @property
    def fmu_variable(self) -> Variable:
        """The FMU's variable.

        Raises:
            ConfigError: If there is none; a ``ConsequenceError`` if its name has a mistake.
        """
        if self.in_fmu is None:
            if self.entry.mistakes.explain(self.entry.child("name").keys):
                raise ConsequenceError(f"the name of {self.alias!r} in the FMU has a mistake")
            raise self.entry.error(
                f"{self.alias!r} is no variable of the FMU; give the FMU's name of it: "
                f'{self.alias} = {{ name = "..." }}'
            )
        return self.in_fmu


class TaskVariables:
    """The variables by their aliases; a variable of the FMU needs no declaration to be used.

    Args:
        root: The table of all keys.
        description: The FMU's model description.

    Attributes:
        units: Units of the FMU that the task gives, by the names of variables of the FMU.
    """

    def __init__(self, root: Entry, description: ModelDescription) -> None:
        self._root, self._entries = root, root.child("variables").items()
        self.units = _units_in_fmu(self._entries, description)
        self._description = description.with_units(self.units)
        self._variables: dict[str, TaskVariable] = {}
        for name, entry in self._entries.items():
            with entry.noting():
                self._variables[name] = self._declared(entry)

    def declared(self) -> list[TaskVariable]:
        """The variables that the task declares or has used."""
        return list(self._variables.values())

    def names(self) -> list[str]:
        """The aliases, and the names of the FMU's variables."""
        return [*self._entries, *self._variables, *self._description.variables]

    def names_in_fmu(self, aliases: Sequence[str]) -> list[str]:
        """The FMU's names of variables."""
        return [self[alias].fmu_variable.name for alias in aliases]

    def get(self, alias: str) -> TaskVariable | None:
        """The variable of an alias or of a variable of the FMU; None if there is none.

        Raises:
            ConfigError: If several variables of the FMU have the name.
        """
        known = self._variables.keys() | self._entries.keys()
        if alias not in known and alias not in self._description.variables:
            alias = Spellings("name", known).find(alias) or alias
        in_fmu = None if alias in known else self._description.find(alias)
        if in_fmu is not None and normal_form(in_fmu.name) == normal_form(alias):
            alias = in_fmu.name
        if in_fmu is not None and alias not in known:
            entry = self._root.child("variables").child(alias)
            self._variables[alias] = self._variable(alias, entry, in_fmu)
        return self._variables.get(alias)

    def __getitem__(self, alias: str) -> TaskVariable:
        variable = self.get(alias)
        if variable is None:
            self.require_unhidden(alias)
            raise unknown_name("variable", alias, self.names())
        return variable

    def require_unhidden(self, name: str) -> None:
        """Check that no mistake that is known already may be why there is no such name.

        Raises:
            ConsequenceError: If one may be. It is where the name is declared.
        """
        mistakes, sources = self._root.mistakes, self._root.sources
        sections = (*NAMING, "reward", "costs", "kpis")
        values = {section: self._root.child(section).value for section in sections}
        places = [
            (section, name)
            for section, value in values.items()
            if value is None or (isinstance(value, Mapping) and name in value)
        ]
        setpoints = self._root.child("setpoints").items()
        places += [("setpoints", one) for one in setpoints if name.startswith(f"{one}_")]
        misspelt = [s.document.get(key) for key in mistakes.unknown_sections for s in sources]
        is_misspelt = any(isinstance(one, Mapping) and name in one for one in misspelt)
        is_hidden = not mistakes.hidden.isdisjoint((name, name.partition(".")[0]))
        if is_hidden or is_misspelt or any(map(mistakes.explain, places)):
            raise ConsequenceError(f"{name!r} has a mistake where it is declared")

    def find(self, entry: Entry, name: str, role: str, others: Sequence[str] = ()) -> TaskVariable:
        """The variable of a name.

        Args:
            entry: Entry of the task.
            name: The name.
            role: Role of the variable, for the error.
            others: More names to suggest.

        Raises:
            ConfigError: If there is none, with the nearest name.
        """
        variable = self.get(name)
        if variable is None:
            self.require_unhidden(name)
            error = unknown_name(role, name, [*others, *self.names()])
            raise entry.error(f"{error}{self._dotted(name, entry.value)}")
        return variable

    def _dotted(self, name: str, value: object) -> str:
        """Explain that TOML reads a name with dots as tables, if that explains an unknown name."""
        while isinstance(value, Mapping) and value:
            key = next(iter(value))
            name, value = f"{name}.{key}", value[key]
            if self.get(name) is not None:
                return f' (a name with dots stands in quotes: "{name}")'
        return ""

    def input_of(self, entry: Entry, unit: str | None) -> TaskVariable:
        """The variable of an input that data are written to, in the unit of the data.

        Args:
            entry: The name of the input: an alias, or the FMU's.
            unit: The unit of the data; None for that of the variable.

        Raises:
            ConfigError: If there is no such input, or the unit does not fit it.
        """
        variable = self.find(entry, entry.value, "input")
        self.check_input(entry, variable)
        if unit is None or variable.in_fmu is None:
            return variable
        with entry.placing():
            conversion = conversion_of(variable.in_fmu, unit, self._description.units)
            return replace(variable, conversion=conversion)

    def check_input(self, entry: Entry, variable: TaskVariable) -> None:
        """Check that a variable can be written before each step; one without the FMU's name can.

        Raises:
            ConfigError: If it cannot.
        """
        if (variable.entry.value or {}).get("sample", "last") != "last":
            raise variable.entry.error("'sample' is for variables that are read from the FMU")
        if variable.in_fmu is not None:
            with entry.placing():
                check_input(
                    self._description, self._description.variable(variable.fmu_variable.name)
                )

    def check_output(self, entry: Entry, name: str) -> None:
        """Check that a variable can be read after each step.

        Raises:
            ConfigError: If it cannot.
        """
        if self[name].delta or self[name].is_switched or self[name].levels:
            raise self[name].entry.error(f"{name!r} is observed, not an action: it has no such key")
        with entry.placing():
            check_output(
                self._description, self._description.variable(self[name].fmu_variable.name)
            )

    def _declared(self, entry: Entry) -> TaskVariable:
        name = entry.child("name")
        if name.value is None:
            return self._variable(entry.name, entry, self._description.find(entry.name))
        if self._description.find(name.value) is None:
            self.require_unhidden(name.value)
        with name.placing():
            return self._variable(entry.name, entry, self._description.variable(name.value))

    def _variable(self, alias: str, entry: Entry, in_fmu: Variable | None) -> TaskVariable:
        given = entry.value or {}
        sample = given.get("sample", "last")
        own = None if in_fmu is None else in_fmu.unit
        if sample == "integral" and own is not None:
            own = f"({own}).s"
        unit, conversion = given.get("unit", own), IDENTITY
        with entry.child("unit").placing():
            if in_fmu is not None:
                units = self._description.units
                conversion = conversion_of(replace(in_fmu, unit=own), unit, units)
        limited = None if sample == "integral" else in_fmu
        if "delta" in given and "levels" in given:
            raise entry.error("an action has either 'levels' or 'delta'")
        limits = _limits(entry, limited, conversion)
        if in_fmu is not None:
            ends = sorted(map(conversion.inverse, limits))
            bounds = (ends[0], ends[1]) if given.keys() & {"min", "max"} else None
            in_fmu = replace(in_fmu, bounds=bounds, sampling=sample)
        return TaskVariable(
            *(alias, entry, in_fmu, unit, conversion, limits),
            nominal=given.get("nominal", _own_nominal(limited, conversion)),
            device=read_device(entry),
            **{key: given[key] for key in _PLAIN if key in given},
        )


def _units_in_fmu(entries: Mapping[str, Entry], description: ModelDescription) -> dict[str, str]:
    """The units that the task gives to variables of the FMU, by their names there.

    All aliases of a variable, and its own name, go by the same one.
    """
    found: dict[str, str] = {}
    for alias, entry in entries.items():
        unit = entry.child("fmu_unit")
        with unit.noting():
            if unit.value is not None:
                own = _with_unit(alias, entry, description)
                if own is not None and found.setdefault(own.name, unit.value) != unit.value:
                    raise unit.error(
                        f"{own.name!r} of the FMU has one unit: expected that of another of its "
                        f"names, {shown(found[own.name])}, got {shown(unit.value)}"
                    )
    return found


def _with_unit(alias: str, entry: Entry, description: ModelDescription) -> Variable | None:
    """The scalar or array to which a task gives a unit; None if its name has a mistake."""
    name = entry.child("name").value
    variable = description.find(alias if name is None else name)
    if variable is None and name is None:
        raise entry.child("fmu_unit").error(f"{alias!r} is no variable of the FMU")
    if variable is not None and not variable.is_number:
        raise entry.child("fmu_unit").error(
            f"{variable.name!r} is of type {variable.type}, which has no unit"
        )
    return variable if variable is None or variable.array is None else variable.array


def _limits(entry: Entry, variable: Variable | None, conversion: Conversion) -> Limits:
    """Limits of the task, or else of the FMU."""
    own = (-math.inf, math.inf) if variable is None else variable.extremes
    low, high = read_limits(entry, *sorted(map(conversion, own)))
    if entry.value and not low < high and entry.value.keys() & {"min", "max"}:
        raise entry.error(f"min must be below max, got {low:g} and {high:g}")
    return low, high


def _own_nominal(variable: Variable | None, conversion: Conversion) -> float | None:
    """The nominal value of the FMU, unless its unit has another zero."""
    own = None if variable is None else variable.nominal
    return None if not own or conversion.offset else abs(own * conversion.factor)


def has_fmu_values(variable: TaskVariable) -> bool:
    """Whether the task gives the values to the FMU without a change."""
    is_same = variable.conversion == IDENTITY and not variable.levels
    return is_same and variable.is_direct


def declared_start(variable: TaskVariable, entry: Entry) -> Any:
    """The value of a parameter: a number or distribution in the unit of the FMU, or a text.

    Raises:
        ConfigError: If the variable cannot be set, or the value does not fit it.
    """
    in_fmu = variable.fmu_variable
    if not in_fmu.settable_at_start:
        raise entry.error(
            f"{in_fmu.name!r} cannot be set at the start of an episode: it is a "
            f"{in_fmu.variability} {in_fmu.causality}"
        )
    if in_fmu.shape:
        return _array_start(variable, entry)
    value, is_text = entry.value, bool(in_fmu.items) or in_fmu.kind == "string"
    with entry.placing():
        if not (isinstance(value, str) and is_text):
            value = number_or_distribution(entry.name, value, draws_texts=is_text)
        value = _in_unit_of_fmu(variable.conversion, value)
        if in_fmu.kind == "string":
            return value
        return within(in_fmu, checked(in_fmu, value))


def _array_start(variable: TaskVariable, entry: Entry) -> Any:
    """The value of an array: nested lists, or one value for all elements, in the FMU's unit."""
    in_fmu, conversion = variable.fmu_variable, variable.conversion
    with entry.placing():
        parts = spread(in_fmu.name, in_fmu.elements, entry.value)
        if conversion != IDENTITY:
            numbers = [number_or_distribution(entry.name, part) for part in parts]
            parts = [_in_unit_of_fmu(conversion, number) for number in numbers]
        for element, part in zip(in_fmu.elements, parts, strict=True):
            within(element, checked(element, part))
    return entry.value if conversion == IDENTITY else _nested(parts, in_fmu.shape)


def _nested(parts: Sequence[Any], shape: tuple[int, ...]) -> Any:
    """The elements of an array in row-major order as nested lists."""
    array = np.empty(len(parts), object)
    array[:] = parts
    return array.reshape(shape).tolist()


def _in_unit_of_fmu(conversion: Conversion, value: Any) -> Any:
    """Convert a number or a distribution.

    Raises:
        ConfigError: If such a distribution cannot be converted.
    """
    if conversion == IDENTITY or isinstance(value, str):
        return value
    if not is_distribution(value):
        return conversion.inverse(value)
    match value:
        case Uniform():
            low, high = sorted(map(conversion.inverse, (value.low, value.high)))
            return Uniform(low, high)
        case Normal():
            low, high = sorted(map(conversion.inverse, (value.low, value.high)))
            std = value.std / abs(conversion.factor)
            return Normal(conversion.inverse(value.mean), std, low, high)
        case LogUniform() if conversion.offset == 0.0 and conversion.factor > 0.0:
            return LogUniform(conversion.inverse(value.low), conversion.inverse(value.high))
        case Choice():
            return Choice([*map(conversion.inverse, value.values)], value.probabilities)
    raise ConfigError(
        f"{shown(value)} cannot be converted to the FMU's unit; leave 'unit' out and give it in "
        "the FMU's unit"
    )


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


def check_items_of_controller(entry: Entry, variable: TaskVariable, controller: Controller) -> None:
    """Check the numbers that a controller of a warm-up writes to an Enumeration.

    Raises:
        ConfigError: If one is no item.
    """
    from fmugym.control import Constant, Hysteresis, Schedule

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
