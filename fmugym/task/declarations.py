"""Sections of a task, read and checked against the FMU.

Characters in names that only look like those of declared names are replaced by these.
"""

from __future__ import annotations

import keyword
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, Final, TypeVar

import numpy as np

from fmugym.checks import Spellings, normal_form
from fmugym.errors import ConfigError
from fmugym.expressions.functions import FUNCTIONS
from fmugym.expressions.language import CONSTANTS, Expression
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.units import IDENTITY
from fmugym.keys import Table
from fmugym.task.data_rows import standard_time
from fmugym.task.scenarios import chosen_files, file_lists, read_fitted
from fmugym.task.section_entries import Limits, Term, read_derived, read_kpi, read_memory, read_term
from fmugym.task.series import read_data
from fmugym.task.set_points import SetPoints
from fmugym.task.task_entries import Entry
from fmugym.task.task_keys import DEVICE, SETPOINT
from fmugym.task.task_variables import (
    NAMING,
    TaskVariable,
    TaskVariables,
    check_levels,
    declared_start,
)
from fmugym.task.warm_up_table import read_warm_up

__all__ = ["BUILT_IN", "Declarations", "as_declared", "is_reserved"]

_DECLARING: Final = ("variables", "memory", "expressions", "data", "setpoints")
_TERMS: Final = ("reward", "costs", "kpis")

_NAMES: Final = (
    *(("agent", name) for name in ("actions", "observations")),
    *(("agent", name, "of") for name in ("forecast", "history")),
    ("setpoints", "*", "of"),
    ("data", "*", "input"),
)
"""The places of names; ``*`` stands for any key. Lists are looked through."""


NameOf = Callable[[str], str]


def as_declared(root: Entry, description: ModelDescription) -> tuple[Entry, NameOf]:
    """A task in which each name stands as it is declared, or else as the FMU has it.

    Args:
        root: The table of all keys.
        description: Description of the FMU.

    Returns:
        The table, and the function that brings names into this form.
    """
    values = root.value or {}
    names = list(_declared_in(values))
    spellings = Spellings("name of the task", dict.fromkeys(names))

    def name_of(name: str) -> str:
        if name in description.variables:
            return name
        try:
            own, in_fmu = spellings.find(name), description.find(name)
        except ConfigError:  # it may be several, which is told where it is used
            return name
        if own is not None:
            return own
        return normal_form(name) if in_fmu is None else in_fmu.name

    return replace(root, value=_renamed(values, (), name_of)), name_of


def _declared_in(values: Mapping[str, Any]) -> Any:
    """Names that a task declares, with the names that set points add."""
    for section in (*_DECLARING, *_TERMS):
        given = values.get(section)
        yield from given if isinstance(given, Mapping) else ()
    points = values.get("setpoints")
    tables = (key.kind.keys for key in SETPOINT.keys.values() if isinstance(key.kind, Table))
    suffixes = {"error", *(key for table in tables for key in table)}
    for name in points if isinstance(points, Mapping) else ():
        yield from (f"{name}_{suffix}" for suffix in suffixes)


def _renamed(value: Any, keys: tuple[str, ...], name_of: Callable[[str], str]) -> Any:
    if isinstance(value, Expression):
        return value.renamed(name_of)
    if isinstance(value, list):
        return [_renamed(one, keys, name_of) for one in value]
    if isinstance(value, Mapping) and "distribution" not in value:
        return {key: _renamed(one, (*keys, key), name_of) for key, one in value.items()}
    if isinstance(value, str) and any(_fits(keys, place) for place in _NAMES):
        return name_of(value)
    return value


def _fits(keys: tuple[str, ...], place: tuple[str, ...]) -> bool:
    pairs = zip(keys, place, strict=False)
    return len(keys) == len(place) and all(wanted in ("*", key) for key, wanted in pairs)


_Read = TypeVar("_Read")

BUILT_IN: Final = ("time", "clock", "elapsed", "step", "dt", "dt_h", "done")
"""Names that every task has in its expressions."""

_RESERVED: Final = frozenset({*BUILT_IN, *CONSTANTS, *FUNCTIONS, "previous"})


def is_reserved(name: str) -> bool:
    """Whether a name cannot be an alias, because it has a meaning of its own in expressions."""
    return name in _RESERVED or keyword.iskeyword(name)


class Declarations:
    """Sections of a task, read and checked.

    Attributes:
        root: The table of all keys.
        variables: The variables.
        is_physical: Whether observations and actions are in the units of the task; see
            ``Task.physical``.
        parameters: Parameters and start values by alias: the variable, and a value or distribution
            in the unit of the FMU.
        memory, derived: Memory variables and named expressions, by name.
        series: Data and schedules by name.
        files: By episode variable, the numbers of the files that an episode may take.
        steps: Set points that jump, by name.
        actions: The variables that the agent writes.
        inputs: Inputs that expressions write, by alias.
        places_of_inputs: Where the task says so.
        name_of: Returns a name as it is declared.
        observed: The names that the agent sees, and where they stand.
        remembered: The names of which it sees the history.
        rewards, costs: By name; a reward without a table has the name ``""``.
        flags: The conditions ``terminated`` and ``truncated``, as far as the task has them.
        deviations: Deviations from set points, by name.
        kpis: KPIs by name.
        warm_up: Warm-up before an episode.
    """

    def __init__(
        self, root: Entry, description: ModelDescription, is_physical: bool = False
    ) -> None:
        """Read all sections, and note mistakes and values that do not fit the FMU."""
        root, self.name_of = as_declared(root, description)
        self.root, self.is_physical = root, is_physical
        self.variables = TaskVariables(root, description)
        self._declared = {one: None for name in NAMING[1:] for one in root.child(name).value or ()}
        _check_names(root)
        self.memory = _read(root, "memory", read_memory)
        self.derived = _read(root, "expressions", read_derived)
        self.series = _read(root, "data", partial(read_data, standard=_standard_offset(root)))
        self.files = self._read_files()
        self._read_setpoints()
        parameters = _read(root, "parameters", self._parameter)
        self.parameters = self._with_fitted({v.alias: (v, one) for v, one in parameters.values()})
        self.actions = self._read_actions()
        self.inputs = self._read_inputs()
        self.observed: list[tuple[Entry, str]] = []
        for entry in self._listed("observations"):
            with entry.noting():
                self._check_observed(entry)
                self.observed.append((entry, entry.value))
        self.remembered = self._read_remembered()
        self.warm_up = read_warm_up(root, self.actions, self._controlled(), self.name_of)
        reward = root.child("reward")
        if isinstance(reward.value, Expression):
            self.rewards = {"": Term(reward, reward.value)}
        else:
            self.rewards = _read(root, "reward", read_term)
        self.costs = _read(root, "costs", read_term)
        self.kpis = _read(root, "kpis", read_kpi)
        conditions = [root.child(name) for name in ("terminated", "truncated")]
        self.flags = {e.name: e.value for e in conditions if e.value is not None}

    @property
    def own_names(self) -> list[str]:
        """Names that belong to no variable, also if their entries have mistakes."""
        return [*self.memory, *self.derived, *self.series, *self.steps, *self._declared]

    def is_own(self, name: str) -> bool:
        """Whether a name is in ``own_names``, which may have thousands."""
        return any(
            name in known
            for known in (self.memory, self.derived, self.series, self.steps, self._declared)
        )

    @property
    def has_reward_terms(self) -> bool:
        """Whether infos report several rewards by name."""
        return list(self.rewards) not in ([], [""])

    @property
    def written(self) -> list[str]:
        """The aliases of the FMU's inputs, in their order."""
        of_actions = [variable.alias for variable in self.actions if variable.in_fmu is not None]
        return of_actions + list(self.inputs)

    def _read_remembered(self) -> list[str]:
        found = []
        for entry in self.root.child("agent").child("history").child("of").elements():
            with entry.noting():
                self._find(entry, "variable")
                found.append(entry.value)
        return found

    def _find(self, entry: Entry, role: str) -> TaskVariable | None:
        """Find the variable of a name; None for other names."""
        if self.is_own(entry.value):
            return None
        return self.variables.find(entry, entry.value, role, self.own_names)

    @property
    def measured(self) -> list[str]:
        """Names that the agent observes, or whose deviation it observes."""
        names = [name for _, name in self.observed] + self.remembered
        return names + [self.deviations[name].of for name in names if name in self.deviations]

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
            *(kpi.expression for kpi in self.kpis.values()),
            *map(Expression.parse, self.warm_up.measured()),
        ]

    def is_output(self, name: str) -> bool:
        """Whether a name stands for a value that is read from the FMU after each step."""
        if self.is_own(name) or name in self.parameters or name in _RESERVED:
            return False
        if name in self.written:
            return False
        try:
            variable = self.variables.get(name)
        except ConfigError:  # it may be several, which is told where the name is used
            return False
        return variable is not None and variable not in self.actions

    def limits_of(self, name: str) -> Limits:
        """The limits of something that the agent observes."""
        if name in self.deviations:
            low, high = self.limits_of(self.deviations[name].setpoint)
            least, most = self.limits_of(self.deviations[name].of)
            return low - most, high - least
        for section in (self.series, self.steps, self.memory, self.derived):
            if name in section:
                return section[name].limits
        return self.variables[name].limits

    def agent_entry(self, key: str) -> Entry:
        """The entry of a key of the agent.

        Raises:
            ConfigError: If the task says nothing of an agent.
        """
        return self.root.required("agent").child(key)

    @property
    def rescales(self) -> bool:
        """Whether actions go from -1 to 1."""
        return bool(self.agent_entry("rescale").value) and not self.is_physical

    def range_of(self, variable: TaskVariable) -> Limits:
        """The lowest and the highest number of an action, in the form of the actions."""
        if self.is_physical:
            return variable.range
        return (-1.0, 1.0) if self.rescales else variable.chosen

    @property
    def normalization(self) -> str | None:
        """Divisor of observations: ``"limits"`` or ``"nominal"``; None for no normalization."""
        kind = self.agent_entry("normalize").value
        if self.is_physical or not kind:
            return None
        return "limits" if kind is True else str(kind)

    @property
    def unphysical_keys(self) -> tuple[str, ...]:
        """The keys for which observations or actions are not in the units of the task."""
        if self.is_physical:
            return ()
        given = {
            "normalize": self.normalization is not None,
            "rescale": self.rescales,
            "levels": any(variable.levels for variable in self.actions),
            "delta": any(variable.delta for variable in self.actions),
        }
        return tuple(key for key, is_given in given.items() if is_given)

    def nominal_of(self, name: str) -> float | None:
        """The usual size of something that the agent observes; None if it is not known.

        That is the larger one of its limits where no nominal value is given.
        """
        variable = None if self.is_own(name) else self.variables[name]
        if variable is not None and variable.nominal is not None:
            return variable.nominal
        size = max(map(abs, self.limits_of(name)))
        return size if 0 < size < np.inf else None

    def _read_files(self) -> dict[str, Sequence[int]]:
        with self.root.child("file").noting():
            lists = file_lists(self.root)
            chosen = chosen_files(self.root.child("file"), lists)
            numbers = {variable: range(len(rows)) for variable, rows in lists.items()}
            return numbers | {variable: (number,) for variable, number in chosen.items()}
        return {}

    def _read_setpoints(self) -> None:
        section = self.root.child("setpoints")
        points = SetPoints(self.memory, self.series, self.derived)
        taken = {*self.memory, *self.derived, *self.series}
        for entry in section.items().values():
            with entry.noting():
                points.add(entry)
        for name in points.brought & taken - section.items().keys():
            text = f"{name!r} is a name that a set point brings with it; rename the other one"
            section.note(section.error(text))
        self.steps, self.deviations = points.steps, points.deviations
        for name, deviation in list(points.deviations.items()):
            of = section.child(deviation.setpoint).child("of")
            if name in self.derived:  # otherwise it is no name at all, which is known
                with of.noting():
                    self._find(of, "variable")
            if self.root.mistakes.explain(of.keys):
                self.derived.pop(name, None)
                del self.deviations[name]

    def _controlled(self) -> list[tuple[str, str]]:
        """Pairs of a measured value and its set point, as far as the task tells them.

        Without set points ``of`` something, the only one is that of the only observed variable.
        """
        if self.deviations:
            return [(one.of, one.setpoint) for one in self.deviations.values()]
        written = {*self.own_names, *(variable.alias for variable in self.actions)}
        measured = [name for _, name in self.observed if name not in written]
        return list(product(measured, self.root.child("setpoints").items()))

    def _listed(self, key: str) -> list[Entry]:
        """The names in a list of the agent; a bare name stands for one."""
        entry = self.root.child("agent").child(key)
        names = entry.elements()
        texts = [name.value for name in names]
        with entry.noting():
            if not names:
                self.root.required("agent")
                raise entry.lack(f"{key} must name at least one variable")
            twice = next((text for text, count in Counter(texts).items() if count > 1), None)
            if twice is not None:
                raise entry.error(f"{twice!r} is named twice; leave one of both out")
        return names

    def _with_fitted(
        self, parameters: dict[str, tuple[TaskVariable, Any]]
    ) -> dict[str, tuple[TaskVariable, Any]]:
        """Parameters of the task, with the fitted ones in place of those of the same name."""
        entry = self.root.child("fitted")
        if entry.value is None:
            return parameters
        aliases = {variable.fmu_variable.name: alias for alias, (variable, _) in parameters.items()}
        fitted: dict[str, tuple[TaskVariable, Any]] = {}
        with entry.noting():
            for name, column in read_fitted(entry).items():
                variable = self.variables.find(entry, aliases.get(name, name), "variable")
                in_its_unit = replace(variable, conversion=IDENTITY)
                value = declared_start(in_its_unit, replace(entry, value=column))
                fitted[variable.alias] = variable, value
        return {k: one for k, one in parameters.items() if k not in fitted} | fitted

    def _parameter(self, entry: Entry) -> tuple[TaskVariable, Any]:
        variable = self.variables.find(entry, entry.name, "variable")
        return variable, declared_start(variable, entry)

    def _read_actions(self) -> list[TaskVariable]:
        actions: list[TaskVariable] = []
        for entry in self._listed("actions"):
            with entry.noting():
                variable = self.variables.find(entry, entry.value, "action")
                actions.append(variable)
                self.variables.check_input(entry, variable)
                _check_action(variable)
                check_levels(variable)
        return actions

    @property
    def are_choices(self) -> bool:
        """Whether an agent chooses a level of each action; otherwise actions are numbers."""
        return all(variable.levels for variable in self.actions)

    @property
    def knows_actions(self) -> bool:
        """Whether no mistake hides an action."""
        return not self.root.mistakes.explain(("agent", "actions"))

    def _read_inputs(self) -> dict[str, tuple[TaskVariable, Expression]]:
        found, self.places_of_inputs = {}, dict[str, Entry]()
        for name, series in self.series.items():
            target = series.entry.child("input")
            with target.noting():
                if target.value is not None:
                    variable = self.variables.input_of(target, series.unit)
                    _require_plain_input(variable)
                    found[variable.alias] = variable, Expression.parse(name)
                    self.places_of_inputs[variable.alias] = target
        return found | {v.alias: (v, one) for v, one in self._read_expressions()}

    def _read_expressions(self) -> Iterator[tuple[TaskVariable, Expression]]:
        """The inputs that expressions write."""
        for entry in self.root.child("inputs").items().values():
            with entry.noting():
                variable, expression = self._input(entry)
                self.places_of_inputs[variable.alias] = entry
                yield variable, expression

    def _input(self, entry: Entry) -> tuple[TaskVariable, Expression]:
        variable = self.variables.find(entry, entry.name, "input")
        if variable in self.actions and variable.in_fmu is not None:
            raise entry.error(f"{entry.name!r} is an action already")
        self.variables.check_input(entry, variable)
        _require_plain_input(variable)
        if entry.value is None:
            raise entry.lack("an input needs an expression")
        return variable, entry.value

    def _check_observed(self, entry: Entry) -> None:
        variable = self._find(entry, "observation")
        if variable is not None and variable not in self.actions:
            if not self.knows_actions and variable.fmu_variable.causality == "input":
                return
            self.variables.check_output(entry, entry.value)


def _standard_offset(root: Entry) -> int | None:
    """The offset of the standard time; None if nothing tells it, or files differ in it."""
    with root.child("timezone").noting():
        return standard_time(root).offset
    return None


def _check_action(variable: TaskVariable) -> None:
    if variable.in_fmu is None and not variable.is_direct:
        raise variable.entry.error(
            f"{variable.alias!r} is no input of the FMU: 'delta', 'min_on', 'min_off' and "
            f"{', '.join(map(repr, DEVICE))} are for inputs"
        )
    if not np.isfinite(variable.range).all():
        raise variable.entry.lack(
            f"the action {variable.alias!r} needs limits, which the FMU does not give: "
            "give it 'min' and 'max', or 'levels'",
            *("min", "max", "levels"),
        )


def _require_plain_input(variable: TaskVariable) -> None:
    """Refuse keys of actuators for an input that no action writes: they would do nothing."""
    if not variable.is_direct or variable.levels:
        raise variable.entry.error(
            f"{variable.alias!r} is written by an expression, not by an action: only 'name', "
            "'unit', 'min' and 'max' are for it"
        )


def _check_names(root: Entry) -> None:
    """A name must mean one thing. Aliases may hide names of the FMU."""
    seen: dict[str, Entry] = {}
    for section in NAMING:
        for entry in root.child(section).items().values():
            with entry.noting():
                _check_name(entry, seen)
            seen.setdefault(normal_form(entry.name), entry)


def _check_name(entry: Entry, seen: Mapping[str, Entry]) -> None:
    name, first = entry.name, seen.get(normal_form(entry.name))
    if first is not None:
        raise entry.error(
            f"the name {name!r} is given twice, also at {first.source.place(first.keys)}; rename "
            "one of both, and what reads it"
        )
    if is_reserved(normal_form(name)):
        raise entry.error(f"{name!r} has a meaning of its own in expressions")
    if not name.isidentifier():
        raise entry.error(
            f"{name!r} cannot be used in expressions; choose a name of letters, digits and _"
        )


def _read(root: Entry, section: str, read: Callable[[Entry], _Read]) -> dict[str, _Read]:
    """Read the entries of a section by name, as far as they have no mistakes."""
    found = {}
    for name, entry in root.child(section).items().items():
        with entry.noting():
            found[name] = read(entry)
    return found
