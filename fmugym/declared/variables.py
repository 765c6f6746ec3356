"""The variables of a task: one record for each, on every path between the task and the FMU."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from fmugym.archive.description import ModelDescription
from fmugym.archive.units import IDENTITY, Conversion, conversion_between
from fmugym.archive.variable import Variable
from fmugym.checks import check_option
from fmugym.declared.devices import DEVICE_KEYS, IDEAL, Device, read_device
from fmugym.declared.entries import Entry
from fmugym.declared.quantities import duration
from fmugym.declared.values import number, number_or_distribution
from fmugym.distributions import Choice, Normal, Uniform, is_distribution
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.pool.spec import SAMPLINGS
from fmugym.task.ranges import within
from fmugym.task.roles import input_variable, output_variable
from fmugym.task.starting import checked, spread

__all__ = [
    "VARIABLE_KEYS",
    "Record",
    "Records",
    "converted",
    "inverted",
    "is_plain",
    "start_value",
]

VARIABLE_KEYS: Final = (
    *("name", "unit", "min", "max", "nominal", "levels", "delta", "min_on", "min_off", "sample"),
    *DEVICE_KEYS,
    "description",
)
"""The keys of a variable."""


_OF_ACTUATOR: Final = ("delta", "min_on", "min_off")
_DURATIONS: Final = ("min_on", "min_off")


@dataclass(frozen=True)
class Record:
    """A variable as a task sees it.

    Attributes:
        alias: Its name in the task.
        entry: Where it is declared or used first.
        variable: The FMU's variable; None for an action that only expressions read.
        unit: The unit of the task; None if neither the task nor the FMU gives one.
        conversion: From the FMU's unit to that of the task.
        low, high: The limits in the unit of the task; infinite where there are none.
        nominal: The usual size of its values; None if neither the task nor the FMU says it.
        levels: The values that an action chooses from; empty for a continuous one.
        sample: What a step gives of the values after each substep, one of ``SAMPLINGS``.
        delta: The largest change in a step, which is what the agent chooses; 0 if it chooses the
            value itself.
        device: The sensor of what the agent observes, or the actuator of an action.
        min_on, min_off: How many seconds an action stays other than 0, and stays 0, at least.
    """

    alias: str
    entry: Entry
    variable: Variable | None
    unit: str | None
    conversion: Conversion
    low: float
    high: float
    levels: tuple[float, ...] = ()
    sample: str = "last"
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
    def range(self) -> tuple[float, float]:
        """The lowest and the highest value of an action."""
        return (min(self.levels), max(self.levels)) if self.levels else (self.low, self.high)

    @property
    def fmu_name(self) -> str:
        """The name in the FMU.

        Raises:
            ConfigError: If there is none.
        """
        if self.variable is None:
            raise self.entry.error(
                f"{self.alias!r} is no variable of the FMU; give the FMU's name of it: "
                f'{self.alias} = {{ name = "..." }}'
            )
        return self.variable.name

    @property
    def own_range(self) -> tuple[float, float] | None:
        """The limits in the unit of the FMU; None if the task gives none of them."""
        given = self.entry.value or {}
        if "min" not in given and "max" not in given:
            return None
        low, high = sorted(map(self.conversion.inverse, (self.low, self.high)))
        return low, high

    @property
    def is_bounded(self) -> bool:
        """Whether both limits are finite."""
        return math.isfinite(self.low) and math.isfinite(self.high)


class Records:
    """The variables by their aliases; a variable of the FMU needs no declaration to be used.

    Args:
        root: The table of all keys.
        description: The FMU's model description.
    """

    def __init__(self, root: Entry, description: ModelDescription) -> None:
        self._root, self._description = root, description
        section = root.child("variables")
        declared = {} if section.value is None else section.items()
        self._records = {alias: self._declared(entry) for alias, entry in declared.items()}

    def declared(self) -> list[Record]:
        """The variables that the task declares or has used."""
        return list(self._records.values())

    def names(self) -> list[str]:
        """The aliases, and the names of the FMU's variables."""
        return list(dict.fromkeys([*self._records, *self._description.variables]))

    def get(self, alias: str) -> Record | None:
        """The record of an alias or of a variable of the FMU; None if there is none."""
        variable = None if alias in self._records else self._description.find(alias)
        if variable is not None:
            entry = Entry(None, ("variables", alias), self._root.sources)
            self._records[alias] = self._record(alias, entry, variable)
        return self._records.get(alias)

    def __getitem__(self, alias: str) -> Record:
        record = self.get(alias)
        if record is None:
            raise unknown_name("variable", alias, self.names())
        return record

    def find(self, entry: Entry, name: str, role: str, others: Sequence[str] = ()) -> Record:
        """The record of a name.

        Args:
            entry: Where the name stands.
            name: The name.
            role: What it should name, for the error.
            others: More names to suggest.

        Raises:
            ConfigError: If there is none, with the nearest name.
        """
        record = self.get(name)
        if record is None:
            error = unknown_name(role, name, [*others, *self.names()])
            raise entry.error(f"{error}{self._dotted(name, entry.value)}")
        return record

    def _dotted(self, name: str, value: object) -> str:
        """Say what TOML makes of a name with dots, if that explains an unknown name."""
        while isinstance(value, Mapping) and value:
            key = next(iter(value))
            name, value = f"{name}.{key}", value[key]
            if self.get(name) is not None:
                return f' (a name with dots stands in quotes: "{name}")'
        return ""

    def input_of(self, entry: Entry, unit: str | None) -> Record:
        """The record of an input that data are written to, in the unit of the data.

        Args:
            entry: The name of the input: an alias, or the FMU's.
            unit: The unit of the data; None for that of the variable.

        Raises:
            ConfigError: If there is no such input, or the unit does not fit it.
        """
        record = self.find(entry, entry.text(), "input")
        self.check_input(entry, record)
        if unit is None or record.variable is None:
            return record
        with entry.placing():
            own, units = record.variable.unit, self._description.units
            return replace(record, conversion=conversion_between(own, unit, units))

    def check_input(self, entry: Entry, record: Record) -> None:
        """Check that a variable can be written before each step; one without the FMU's name can.

        Raises:
            ConfigError: If it cannot.
        """
        if record.sample != "last":
            raise record.entry.error("'sample' is for variables that are read from the FMU")
        if record.variable is not None:
            with entry.placing():
                input_variable(self._description, record.fmu_name)

    def check_output(self, entry: Entry, name: str) -> None:
        """Check that a variable can be read after each step.

        Raises:
            ConfigError: If it cannot.
        """
        if self[name].delta or self[name].is_switched or self[name].levels:
            raise self[name].entry.error(f"{name!r} is observed, not an action: it has no such key")
        with entry.placing():
            output_variable(self._description, self[name].fmu_name)

    def _declared(self, entry: Entry) -> Record:
        table, alias = entry.table(VARIABLE_KEYS), entry.name
        if "name" not in table:
            return self._record(alias, entry, self._description.find(alias))
        with table["name"].placing():
            return self._record(alias, entry, self._description.variable(table["name"].text()))

    def _record(self, alias: str, entry: Entry, variable: Variable | None) -> Record:
        sample = _sample(entry)
        own = None if variable is None else variable.unit
        if sample == "integral" and own is not None:
            own = f"({own}).s"
        unit = entry.child("unit")
        wanted = own if unit.value is None else unit.text()
        with unit.placing():
            conversion = conversion_between(own, wanted, self._description.units)
        limited = None if sample == "integral" else variable
        low, high = _limits(entry, limited, conversion)
        levels, limits = _levels(entry), _of_actuator(entry)
        device = read_device(entry)
        return Record(
            *(alias, entry, variable, wanted, conversion, low, high, levels, sample),
            nominal=_nominal(entry, limited, conversion),
            device=device,
            **limits,
        )


def _limits(entry: Entry, variable: Variable | None, conversion: Conversion) -> tuple[float, float]:
    """The limits of the task, or else those of the FMU."""
    minimum, maximum = entry.child("min"), entry.child("max")
    low, high = _own_limits(variable, conversion)
    low = low if minimum.value is None else number(minimum)
    high = high if maximum.value is None else number(maximum)
    if not low < high and not (minimum.value is None and maximum.value is None):
        raise entry.error(f"min must be below max, got {low} and {high}")
    return low, high


def _own_limits(variable: Variable | None, conversion: Conversion) -> tuple[float, float]:
    if variable is None:
        return -math.inf, math.inf
    if variable.kind == "boolean":
        return 0.0, 1.0
    values: list[float] = [value for _, value in variable.items]
    limits = (min(values), max(values)) if values else (variable.minimum, variable.maximum)
    low, high = sorted(map(conversion, limits))
    return low, high


def _nominal(entry: Entry, variable: Variable | None, conversion: Conversion) -> float | None:
    """The nominal value of the task, or that of the FMU unless its unit has another zero."""
    nominal = entry.child("nominal")
    if nominal.value is not None:
        value = number(nominal)
        if not 0 < value < math.inf:
            raise nominal.error(f"nominal must be positive, got {value:g}")
        return value
    own = None if variable is None else variable.nominal
    return None if not own or conversion.offset else abs(own * conversion.factor)


def _of_actuator(entry: Entry) -> dict[str, Any]:
    """How much and how often an action may change."""
    given = {key: entry.child(key) for key in _OF_ACTUATOR}
    limits: dict[str, Any] = {}
    for key, one in given.items():
        if one.value is None:
            continue
        limits[key] = one.check(duration) if key in _DURATIONS else number(one)
        if not limits[key] > 0:
            raise one.error(f"{key} must be positive, got {limits[key]:g}")
    if "delta" in limits and "levels" in (entry.value or {}):
        raise entry.error("an action has either 'levels' or 'delta'")
    return limits


def _sample(entry: Entry) -> str:
    sample = entry.child("sample")
    if sample.value is None:
        return "last"
    with sample.placing():
        return check_option("sample", sample.value, SAMPLINGS)


def _levels(entry: Entry) -> tuple[float, ...]:
    levels = entry.child("levels")
    if levels.value is None:
        return ()
    values = tuple(number(level) for level in levels.elements())
    if len(set(values)) < max(2, len(values)) or not all(map(math.isfinite, values)):
        raise levels.error(f"expected two or more different numbers, got {shown(levels.value)}")
    return values


def converted(conversion: Conversion, text: str) -> str:
    """Code that turns a value of the FMU into one of the task."""
    if conversion.factor != 1.0:
        text = f"({text} * {conversion.factor!r})"
    return text if conversion.offset == 0.0 else f"({text} + {conversion.offset!r})"


def inverted(conversion: Conversion, text: str) -> str:
    """Code that turns a value of the task into one of the FMU."""
    if conversion.offset != 0.0:
        text = f"({text} - {conversion.offset!r})"
    return text if conversion.factor == 1.0 else f"({text} / {conversion.factor!r})"


def is_plain(record: Record) -> bool:
    """Whether the values of the task are those of the FMU."""
    is_same = record.conversion == IDENTITY and not record.levels
    return is_same and record.is_direct


def start_value(record: Record, entry: Entry) -> Any:
    """The value of a parameter: a number or distribution in the unit of the FMU, or a text.

    Raises:
        ConfigError: If the variable cannot be set, or the value does not fit it.
    """
    name, variable = record.fmu_name, record.variable
    if variable is None or not variable.settable_at_start:
        what = "" if variable is None else f": it is a {variable.variability} {variable.causality}"
        raise entry.error(f"{name!r} cannot be set at the start of an episode{what}")
    if variable.shape:
        return _array_start(variable, entry, record.own_range)
    if isinstance(entry.value, str) and (variable.items or variable.kind == "string"):
        value: Any = entry.value
    else:
        value = number_or_distribution(entry)
    with entry.placing():
        value = _in_unit_of_fmu(record.conversion, value)
        if variable.kind == "string":
            return value
        return within(variable, checked(variable, value), record.own_range)


def _array_start(variable: Variable, entry: Entry, limits: tuple[float, float] | None) -> Any:
    """The value of an array: nested lists, or one value for all elements, in the FMU's unit."""
    with entry.placing():
        parts = spread(variable.name, variable.elements, entry.value)
        for element, part in zip(variable.elements, parts, strict=True):
            within(element, checked(element, part), limits)
    return entry.value


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
        case Choice():
            return Choice([*map(conversion.inverse, value.values)], value.probabilities)
    raise ConfigError(
        f"{shown(value)} cannot be converted to the FMU's unit; leave 'unit' out and give it in "
        "the FMU's unit"
    )
