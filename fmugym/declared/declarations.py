"""The sections of a task, read and checked against the FMU."""

from __future__ import annotations

import keyword
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from fmugym.archive.description import ModelDescription
from fmugym.declared.devices import DEVICE_KEYS
from fmugym.declared.entries import Entry
from fmugym.declared.expressions import CONSTANTS, Expression
from fmugym.declared.functions import FUNCTIONS
from fmugym.declared.quantities import duration
from fmugym.declared.series import Series, read_data, read_schedule
from fmugym.declared.values import number, number_or_distribution
from fmugym.declared.variables import Record, Records, start_value
from fmugym.declared.warming import WarmUpTable, read_warm_up

__all__ = ["AGENT_KEYS", "BUILT_IN", "SETPOINTS", "Declarations", "Memory", "Term", "is_reserved"]

BUILT_IN: Final = ("time", "clock", "elapsed", "step", "dt", "dt_h", "done")
"""Names that every task has in its expressions."""

AGENT_KEYS: Final = (*("actions", "observations", "forecast", "history", "rescale", "normalize"),)
"""The keys of the agent."""

_RESERVED: Final = frozenset({*BUILT_IN, *CONSTANTS, *FUNCTIONS, "previous"})


def is_reserved(name: str) -> bool:
    """Whether a name cannot be an alias, because it has a meaning of its own in expressions."""
    return name in _RESERVED or keyword.iskeyword(name)


Limits = tuple[float, float]


@dataclass(frozen=True)
class Term:
    """A named reward or cost.

    Attributes:
        entry: Where it stands.
        expression: Its value in a step.
        weight: The factor of a reward.
        limit: What the costs of an episode may add up to; None for no limit.
    """

    entry: Entry
    expression: Expression
    weight: float = 1.0
    limit: float | None = None


@dataclass(frozen=True)
class Memory:
    """A value that the task itself remembers during an episode.

    Attributes:
        entry: Where it stands.
        start: Its value at the beginning: a number or a distribution.
        update: Its value after a step; None to keep it.
        limits: For the observation space.
    """

    entry: Entry
    start: Any
    update: Expression | None
    limits: Limits


@dataclass(frozen=True)
class Derived:
    """A named expression, and its limits for the observation space."""

    entry: Entry
    expression: Expression
    limits: Limits


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


@dataclass
class Declarations:
    """What a task declares.

    Attributes:
        root: The table of all keys.
        records: The variables.
        parameters: Parameters and start values by alias: the record, and a value or distribution in
            the unit of the FMU.
        memory, derived: What the task remembers and names, by name.
        series: Data and schedules by name.
        steps: Set points that jump, by name.
        actions: The variables that the agent writes.
        inputs: Inputs that expressions write, by alias.
        observed: The names that the agent sees, and where they stand.
        rewards, costs: By name; a reward without a table has the name ``""``.
        flags: The conditions ``terminated`` and ``truncated``, as far as the task has them.
        warm_up: What happens before an episode begins.
    """

    root: Entry
    records: Records
    parameters: dict[str, tuple[Record, Any]] = field(init=False)
    memory: dict[str, Memory] = field(init=False)
    derived: dict[str, Derived] = field(init=False)
    series: dict[str, Series] = field(init=False)
    steps: dict[str, Steps] = field(init=False)
    actions: list[Record] = field(init=False)
    inputs: dict[str, tuple[Record, Expression]] = field(init=False)
    observed: list[tuple[Entry, str]] = field(init=False)
    rewards: dict[str, Term] = field(init=False)
    costs: dict[str, Term] = field(init=False)
    flags: dict[str, Expression] = field(init=False)
    warm_up: WarmUpTable = field(init=False)

    @classmethod
    def read(cls, root: Entry, description: ModelDescription) -> Declarations:
        """Read all sections.

        Raises:
            ConfigError: If one has a mistake, or does not fit the FMU. The text says where.
        """
        declared = cls(root, Records(root, description))
        _check_names(root)
        declared.memory = {e.name: _memory(e) for e in _section(root, "memory")}
        declared.derived = {e.name: _derived(e) for e in _section(root, "expressions")}
        declared.series = {e.name: read_data(e) for e in _section(root, "data")}
        declared.steps = {}
        for entry in _section(root, "setpoints"):
            declared._add_setpoint(entry)
        declared.parameters = dict(declared._read_parameters())
        root.required("agent").table(AGENT_KEYS)
        declared.actions = declared._read_actions()
        declared.inputs = dict(declared._read_inputs())
        declared.warm_up = read_warm_up(root, declared.actions)
        declared.observed = list(declared._read_observed())
        declared.rewards = _terms(root.child("reward"), ("expr", "weight"))
        declared.costs = _terms(root.child("costs"), ("expr", "limit"))
        conditions = [root.child(name) for name in ("terminated", "truncated")]
        declared.flags = {e.name: parsed(e) for e in conditions if e.value is not None}
        return declared

    @property
    def own_names(self) -> list[str]:
        """The names that are not those of variables."""
        return [*self.memory, *self.derived, *self.series, *self.steps]

    @property
    def has_reward_terms(self) -> bool:
        """Whether infos report several rewards by name."""
        return list(self.rewards) not in ([], [""])

    @property
    def written(self) -> list[str]:
        """The aliases of the FMU's inputs, in their order."""
        of_actions = [record.alias for record in self.actions if record.variable is not None]
        return of_actions + list(self.inputs)

    @property
    def remembered(self) -> list[str]:
        """The names of which the agent sees the history."""
        history = self.root.child("agent").child("history")
        if history.value is None:
            return []
        history.table(("of", "length"))
        names = history.required("of")
        entries = [names] if isinstance(names.value, str) else names.elements()
        for entry in entries:
            if entry.text() not in self.own_names:
                self.records.find(entry, entry.text(), "variable", self.own_names)
        return [entry.text() for entry in entries]

    @property
    def expressions(self) -> list[Expression]:
        """All expressions, and the names that controllers measure."""
        updates = [memory.update for memory in self.memory.values()]
        terms = [*self.rewards.values(), *self.costs.values()]
        return [
            *(expression for _, expression in self.inputs.values()),
            *(update for update in updates if update is not None),
            *(derived.expression for derived in self.derived.values()),
            *(term.expression for term in terms),
            *self.flags.values(),
            *map(Expression.parse, self.warm_up.signals()),
        ]

    def is_output(self, name: str) -> bool:
        """Whether a name stands for a value that is read from the FMU after each step."""
        if name in {*self.own_names, *self.parameters, *_RESERVED, *self.written}:
            return False
        record = self.records.get(name)
        return record is not None and record not in self.actions

    def limits_of(self, name: str) -> Limits:
        """The limits of something that the agent observes."""
        if name in self.series:
            return self.series[name].low, self.series[name].high
        if name in self.steps:
            return self.steps[name].limits
        if name in self.memory:
            return self.memory[name].limits
        if name in self.derived:
            return self.derived[name].limits
        record = self.records[name]
        return record.low, record.high

    def agent(self, key: str) -> Entry:
        """The entry of a key of the agent.

        Raises:
            ConfigError: If it is missing.
        """
        return self.root.required("agent").required(key)

    def option(self, key: str) -> bool:
        """Whether an option of the agent is set."""
        entry = self.root.child("agent").child(key)
        return entry.value is not None and entry.flag()

    def _add_setpoint(self, entry: Entry) -> None:
        """Add a set point in the form of what the task remembers, a schedule or an expression."""
        is_table = isinstance(entry.value, Mapping) and "distribution" not in entry.value
        kinds = [kind for kind in SETPOINTS if is_table and kind in entry.value]
        if not is_table:
            self.memory[entry.name] = _memory(entry)
            return
        entry.table((*SETPOINTS, "min", "max"))
        if len(kinds) != 1:
            raise entry.error(f"give one of {', '.join(SETPOINTS)}")
        if kinds[0] == "value":
            start = number_or_distribution(entry.child("value"))
            self.memory[entry.name] = Memory(entry, start, None, _limits_of(entry))
        elif kinds[0] == "schedule":
            self.series[entry.name] = read_schedule(entry.child("schedule"))
        elif kinds[0] == "steps":
            self.steps[entry.name] = _steps(entry, len(self.steps))
        else:
            self._add_curve(entry, kinds[0])

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
        self.derived[name] = Derived(entry, expression, _limits_of(entry))

    def _listed(self, key: str) -> list[Entry]:
        """The names in a list of the agent; a bare name stands for one."""
        entry = self.agent(key)
        names = [entry] if isinstance(entry.value, str) else entry.elements()
        if not names:
            raise entry.error(f"{key} must name at least one variable")
        texts = [name.text() for name in names]
        for text in texts:
            if texts.count(text) > 1:
                raise entry.error(f"{text!r} is named twice")
        return names

    def _read_parameters(self) -> Iterator[tuple[str, tuple[Record, Any]]]:
        for entry in _section(self.root, "parameters"):
            record = self.records.find(entry, entry.name, "variable")
            yield entry.name, (record, start_value(record, entry))

    def _read_actions(self) -> list[Record]:
        entry = self.agent("actions")
        actions = [self.records.find(e, e.text(), "action") for e in self._listed("actions")]
        for record in actions:
            self.records.check_input(entry, record)
            if record.variable is None and not record.is_direct:
                raise record.entry.error(
                    f"{record.alias!r} is no input of the FMU: 'delta', 'min_on', 'min_off' and "
                    f"{', '.join(map(repr, DEVICE_KEYS))} are for inputs"
                )
        if len({bool(record.levels) for record in actions}) > 1:
            raise entry.error("either all actions have levels, or none has")
        for record in actions:
            if not record.levels and not record.is_bounded:
                raise record.entry.error(
                    f"the action {record.alias!r} needs limits, which the FMU does not give: "
                    "give it 'min' and 'max', or 'levels'"
                )
        return actions

    def _read_inputs(self) -> Iterator[tuple[str, tuple[Record, Expression]]]:
        for name, series in self.series.items():
            target = series.entry.child("input")
            if target.value is not None:
                unit = series.entry.child("unit")
                record = self.records.input_of(target, None if unit.value is None else unit.text())
                _require_plain_input(record)
                yield record.alias, (record, Expression.parse(name))
        for entry in _section(self.root, "inputs"):
            record = self.records.find(entry, entry.name, "input")
            if record in self.actions and record.variable is not None:
                raise entry.error(f"{entry.name!r} is an action already")
            self.records.check_input(entry, record)
            _require_plain_input(record)
            yield entry.name, (record, parsed(entry))

    def _read_observed(self) -> Iterator[tuple[Entry, str]]:
        for entry in self._listed("observations"):
            name = entry.text()
            if name not in self.own_names:
                record = self.records.find(entry, name, "observation", self.own_names)
                if record not in self.actions:
                    self.records.check_output(entry, name)
            yield entry, name


def _require_plain_input(record: Record) -> None:
    """Refuse keys of actuators for an input that no action writes: they would do nothing."""
    if not record.is_direct or record.levels:
        raise record.entry.error(
            f"{record.alias!r} is written by an expression, not by an action: only 'name', 'unit', "
            "'min' and 'max' are for it"
        )


SETPOINTS: Final = ("value", "schedule", "steps", "ramp", "sine")
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


def _section(root: Entry, name: str) -> list[Entry]:
    section = root.child(name)
    return [] if section.value is None else list(section.items().values())


def parsed(entry: Entry) -> Expression:
    """The expression in an entry."""
    with entry.placing():
        return Expression.parse(entry.value)


def _memory(entry: Entry) -> Memory:
    is_table = isinstance(entry.value, Mapping) and "distribution" not in entry.value
    if not is_table:
        return Memory(entry, number_or_distribution(entry), None, (-np.inf, np.inf))
    table = entry.table(("start", "update", "min", "max"))
    start = number_or_distribution(entry.required("start"))
    update = parsed(table["update"]) if "update" in table else None
    return Memory(entry, start, update, _limits_of(entry))


def _derived(entry: Entry) -> Derived:
    if not isinstance(entry.value, Mapping):
        return Derived(entry, parsed(entry), (-np.inf, np.inf))
    entry.table(("expr", "min", "max"))
    return Derived(entry, parsed(entry.required("expr")), _limits_of(entry))


def _check_names(root: Entry) -> None:
    """A name must mean one thing. Aliases may hide names of the FMU."""
    seen: set[str] = set()
    for section in ("variables", "memory", "expressions", "data", "setpoints"):
        for entry in _section(root, section):
            if entry.name in seen:
                raise entry.error(f"the name {entry.name!r} is given twice")
            if is_reserved(entry.name):
                raise entry.error(f"{entry.name!r} has a meaning of its own in expressions")
            if not entry.name.isidentifier():
                raise entry.error(
                    f"{entry.name!r} cannot be used in expressions; choose a name of letters, "
                    "digits and _"
                )
            seen.add(entry.name)


def _terms(entry: Entry, keys: tuple[str, ...]) -> dict[str, Term]:
    if entry.value is None:
        return {}
    if entry.name == "reward" and not isinstance(entry.value, Mapping):
        return {"": Term(entry, parsed(entry))}
    return {name: _term(term, keys) for name, term in entry.items().items()}


def _term(entry: Entry, keys: tuple[str, ...]) -> Term:
    if not isinstance(entry.value, Mapping):
        return Term(entry, parsed(entry))
    table = entry.table(keys)
    weight = number(table["weight"]) if "weight" in table else 1.0
    limit = number(table["limit"]) if "limit" in table else None
    return Term(entry, parsed(entry.required("expr")), weight, limit)


def _limits_of(entry: Entry) -> Limits:
    low, high = entry.child("min"), entry.child("max")
    limits = (
        -np.inf if low.value is None else number(low),
        np.inf if high.value is None else number(high),
    )
    if not limits[0] < limits[1]:
        raise entry.error(f"min must be below max, got {limits[0]} and {limits[1]}")
    return limits
