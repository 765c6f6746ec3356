"""Table of controllers for several actions, with cascades over signals; as a text, too.

The text is an inline table of TOML: ``{ u = "pid of=T setpoint=21 kp=0.5", v = 0 }``.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import reduce
from graphlib import CycleError, TopologicalSorter
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.checks import Spellings, check_mapping, check_number
from fmugym.control.controller import Controller, Decided, Law, limited
from fmugym.control.standard_controllers import Constant
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.expressions.language import Expression

__all__ = [
    "ControllerTable",
    "Signal",
    "acting_text",
    "controller_in",
    "is_table",
    "named_controllers",
    "naming",
    "parts_of",
    "resolved",
    "table_in",
    "text_of",
    "with_controller",
]

_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")
_KEYS: Final = ("controller", "min", "max")
"""The keys of a signal."""


def is_table(given: Any) -> bool:
    """Whether a text, or a dict, is a table of controllers."""
    return isinstance(given, Mapping) or (isinstance(given, str) and given.lstrip()[:1] == "{")


def table_in(given: Any) -> dict[str, Any]:
    """The entries of a table.

    Args:
        given: A dict, or a text.

    Raises:
        ConfigError: If it is no table, or a signal in it lacks a key or has another one.
    """
    if isinstance(given, str):
        try:
            given = tomllib.loads(f"table = {given.strip()}")["table"]
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(
                f'expected a table such as {{ u = "pid of=T setpoint=21 kp=0.5", v = 0 }}, got '
                f"{shown(given)}: {error}"
            ) from None
    entries = check_mapping("a table of controllers", given)
    for name, entry in entries.items():
        if isinstance(entry, Mapping):
            _require_signal(name, entry)
    if not entries:
        raise ConfigError("a table of controllers needs an entry for each action")
    return entries


def _require_signal(name: str, entry: Mapping[str, Any]) -> None:
    for key in entry:
        if key not in _KEYS:
            raise unknown_name(f"key of {name}", key, _KEYS)
    for key in _KEYS:
        if key not in entry:
            raise ConfigError(f"{name}: the key {key!r} is missing")


def controller_in(entry: Any) -> Any:
    """Controller of an entry for an action or a signal."""
    return entry["controller"] if isinstance(entry, Mapping) else entry


def with_controller(entry: Any, controller: Any) -> Any:
    """The entry with another controller."""
    return {**entry, "controller": controller} if isinstance(entry, Mapping) else controller


def text_of(given: Mapping[str, Any]) -> str:
    """The text of a table, in one line."""
    entries = (f"{_key(name)} = {_value(one)}" for name, one in given.items())
    return f"{{ {', '.join(entries)} }}"


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name)


def _value(value: Any) -> str:
    return text_of(value) if isinstance(value, Mapping) else json.dumps(value)


def named_controllers(given: Mapping[str, Any]) -> dict[str, Any]:
    """The controllers of a task file by name: texts and numbers; a table is a text.

    Args:
        given: What stands there, in which tables may name others.

    Raises:
        ConfigError: If a name in a table is no controller of one number.
    """
    return {name: resolved(one, given) for name, one in given.items()}


def parts_of(given: Mapping[str, Any]) -> set[Any]:
    """Values that stand in tables, names of other controllers among them.

    Args:
        given: As for ``named_controllers``.
    """
    tables = [table_in(one) for one in given.values() if is_table(one)]
    return {controller_in(entry) for table in tables for entry in table.values()}


def resolved(given: Any, known: Mapping[str, Any]) -> Any:
    """A controller without names: a text or a number; a table is a text.

    Args:
        given: A text, a number or a table.
        known: Controllers by name.

    Raises:
        ConfigError: If a name in a table is no controller of one number.
    """
    if not is_table(given):
        return given
    entries = table_in(given)
    return text_of(
        {
            name: with_controller(entry, _named(name, controller_in(entry), known))
            for name, entry in entries.items()
        }
    )


def acting_text(given: Any) -> str:
    """The text of a controller; a number is a schedule that has one action."""
    return given if isinstance(given, str) else f"schedule 00:00={given}"


def _named(name: str, given: Any, known: Mapping[str, Any]) -> Any:
    """Resolve an entry of a table that names another controller."""
    own = Spellings("controller of the task", known).find(given)
    if own is None and known and isinstance(given, str) and given.isidentifier():
        raise ConfigError(f"{name}: {unknown_name('controller of the task', given, known)}")
    if own is not None and is_table(known[own]):
        raise ConfigError(f"{name}: {own!r} is a table; an entry is a controller of one number")
    return given if own is None else known[own]


@dataclass(frozen=True)
class Signal:
    """A number between controllers of a cascade: one gives it, others read it by its name.

    Attributes:
        controller: Gives the number.
        low, high: Its limits.
    """

    controller: Law
    low: float
    high: float

    def __post_init__(self) -> None:
        low, high = check_number("min", self.low), check_number("max", self.high)
        if not low < high:
            raise ConfigError(f"min must be below max, got {low:g} and {high:g}")


class ControllerTable(Law):
    """A controller of several actions, each of which has a controller of its own.

    Entries that are no actions are signals of a cascade: what a controller gives, within limits, is
    what others read by the name of the entry, as a set point for example. The integral of an outer
    controller does not grow where this would only push all that read its signal further beyond
    their limits.

    Args:
        entries: By the name of an action a controller of one number, or a number; by any other name
            a ``Signal``.
    """

    def __init__(self, entries: Mapping[str, Law | Signal | float]) -> None:
        given = check_mapping("entries", entries)
        self.entries = {name: _checked(name, one) for name, one in given.items()}
        self._readers = {name: self._readers_of(name) for name in self.cascaded}
        self._require_read()
        self._order = self._in_order()
        self.starts = tuple(start for name in self._order for start in self._law(name).starts)

    @property
    def cascaded(self) -> list[str]:
        """The names of the signals."""
        return [name for name, one in self.entries.items() if isinstance(one, Signal)]

    @property
    def acting(self) -> dict[str, Law]:
        """The controllers of the actions, by name."""
        return {name: one for name, one in self.entries.items() if not isinstance(one, Signal)}

    def laws(self) -> list[Law]:
        """The controllers of all entries."""
        return [self._law(name) for name in self.entries]

    @property
    def moved(self) -> list[str]:
        """The names of the actions that do not always have the same value, once it is bound."""
        pairs = zip(self.action_names or (), self._columns, strict=True)
        return [name for name, own in pairs if not isinstance(self.entries[own], Constant)]

    def told(self) -> list[tuple[Any, ...]]:
        """Identity of the table, before it is bound."""
        limits = {n: (e.low, e.high) for n, e in self.entries.items() if isinstance(e, Signal)}
        return [
            (name, type(self._law(name)), vars(self._law(name)), limits.get(name))
            for name in self.entries
        ]

    def _law(self, name: str) -> Law:
        entry = self.entries[name]
        return entry.controller if isinstance(entry, Signal) else entry

    def measured(self) -> list[str]:
        """Measured values of the table without its own signals; see ``Law.measured``."""
        found: dict[str, None] = {}
        for text in (text for law in self.laws() for text in law.measured()):
            names = _names_in(text)
            read = [name for name in names if self._signal(name)]
            found |= dict.fromkeys([one for one in names if one not in read] if read else [text])
        return list(found)

    # Dependencies of entries.

    def _signal(self, name: str) -> str | None:
        """The signal of a name; None for the name of something else."""
        return Spellings("signal", self.cascaded).find(name)

    def _read_by(self, name: str) -> set[str]:
        """The signals that an entry reads."""
        names = (one for text in self._law(name).measured() for one in _names_in(text))
        return {signal for one in names if (signal := self._signal(one)) is not None}

    def _readers_of(self, signal: str) -> list[str]:
        return [name for name in self.entries if signal in self._read_by(name)]

    def _require_read(self) -> None:
        for name, readers in self._readers.items():
            if not readers:
                raise ConfigError(
                    f"no entry reads the signal {name!r}; write for example setpoint={name} in one"
                )

    def _in_order(self) -> list[str]:
        """The names of the entries, each after the signals that it reads.

        Raises:
            ConfigError: If they go round in a circle.
        """
        sorter = TopologicalSorter({name: sorted(self._read_by(name)) for name in self.entries})
        try:
            return [*sorter.static_order()]
        except CycleError as error:
            circle = " -> ".join(reversed(error.args[1]))
            raise ConfigError(f"signals are read in a circle: {circle}") from None

    # Its decisions.

    def _prepare(self) -> None:
        parts = self._parts()
        signals = [name for name in self._order if name in self._readers]
        for name in signals:
            if Spellings("observation", self.names).find(name):
                raise ConfigError(f"the signal {name!r} has the name of an observation")
        names = (*self.names, *signals)
        self._places = {name: place for place, name in enumerate(signals, len(self.names))}
        for name in self._order:
            entry = self.entries[name]
            if isinstance(entry, Signal):
                parts[name] = spaces.Box(entry.low, entry.high, (1,), np.float64)
            with naming(name):
                self._law(name).attach(parts[name], names, None, self.time_step, self.count)
        self._limits_of = {name: self._law(name)._limits() for name in self._order}
        super()._prepare()

    def _parts(self) -> dict[str, spaces.Space[Any]]:
        """The space of each action by the name of its entry.

        Raises:
            ConfigError: If the entries are not those of the actions. The text says what to do.
        """
        parts, names = _elements(self.space), self.action_names
        if names is None or len(names) != len(parts):
            raise ConfigError(
                "a hook makes something of the actions, so that they have no names; a table of "
                "controllers needs some: play a task file"
            )
        known = Spellings("action", names)
        found = {known.find(name): name for name in self.acting}
        for name in self.cascaded:
            if known.find(name) is not None:
                raise ConfigError(f"{name!r} is an action, whose limits the task has")
        if None in found:
            text = unknown_name("action", found[None], names)
            raise ConfigError(f"{text}; a signal has 'min' and 'max'")
        for name in names:
            if name not in found:
                raise ConfigError(f"the table has no controller of {name!r}; write {name} = 0, say")
        self._columns = [found[name] for name in names]
        return dict(zip(self._columns, parts, strict=True))

    def law(
        self, seen: Sequence[Any], state: Sequence[Any], holds: Any = False, added: Any = None
    ) -> Decided:
        """See ``Law.law``."""
        more = {} if added is None else dict(zip(self._columns, added, strict=True))
        states = dict(self._divided(state))
        seen = [*seen]
        self._complete(seen, states)
        decided: dict[str, Any] = {}
        for name in self._order:
            held = self._holds(name, seen, states)
            own = [more[name]] if name in more else None
            (decided[name],), states[name] = self._law(name).law(seen, states[name], held, own)
            if name in self._places:
                seen[self._places[name]] = self._limited(name, decided[name])
        remembered = tuple(one for name in self._order for one in states[name])
        return [decided[name] for name in self._columns], remembered

    def _divided(self, state: Sequence[Any]) -> Iterator[tuple[str, Sequence[Any]]]:
        """Memory of each entry."""
        first = 0
        for name in self._order:
            last = first + len(self._law(name).starts)
            yield name, state[first:last]
            first = last

    def _complete(self, seen: list[Any], states: Mapping[str, Any]) -> None:
        """Append the signals as they are if nothing holds their integrals."""
        for name in self._places:
            (value,), _ = self._law(name).law(seen, states[name])
            seen.append(self._limited(name, value))

    def _limited(self, name: str, value: Any) -> Any:
        return limited(value, *self._limits_of[name])

    def _holds(self, name: str, seen: Sequence[Any], states: Mapping[str, Any]) -> Any:
        """Whether a growing integral would only push the readers of an entry beyond limits."""
        law = self._law(name)
        if name not in self._places or not law.integrates:
            return False
        (grown,), _ = law.law(seen, states[name])
        (kept,), _ = law.law(seen, states[name], True)
        return self._beyond(name, grown, seen, states) > self._beyond(name, kept, seen, states)

    def _beyond(self, name: str, value: Any, seen: Sequence[Any], states: Mapping[str, Any]) -> Any:
        """Excess of a value over the range that the entry's limits or its readers use."""
        used = self._limited(name, value)
        beyond = np.abs(value - used)
        if name not in self._places:
            return beyond
        seen = [*seen]
        seen[self._places[name]] = used
        readers = [
            self._beyond(one, self._law(one).wanted(seen, states[one]), seen, states)
            for one in self._readers[name]
        ]
        return beyond + reduce(np.minimum, readers)


def _elements(space: spaces.Space[Any]) -> list[spaces.Space[Any]]:
    """The space of each number of an action.

    Raises:
        ConfigError: If actions are no numbers.
    """
    match space:
        case spaces.Box():
            ends = zip(space.low.flat, space.high.flat, strict=True)
            return [spaces.Box(low, high, (1,), space.dtype.type) for low, high in ends]
        case spaces.Discrete():
            return [space]
        case spaces.MultiDiscrete():
            pairs = zip(space.nvec.flat, space.start.flat, strict=True)
            return [spaces.Discrete(int(count), start=int(start)) for count, start in pairs]
    raise ConfigError(f"a table of controllers gives numbers, but the action space is {space}")


@contextmanager
def naming(entry: str) -> Iterator[None]:
    """Let errors about an entry of a table name it."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{entry}: {error}") from None


def _checked(name: str, entry: Any) -> Law | Signal:
    controller = entry.controller if isinstance(entry, Signal) else entry
    if isinstance(controller, int | float) and not isinstance(entry, Signal):
        return Constant(check_number(name, controller, may_be_boolean=True))
    if isinstance(controller, ControllerTable) or not isinstance(controller, Law):
        is_one = isinstance(controller, Controller)
        kind = type(controller).__name__ if is_one else shown(controller)
        raise ConfigError(
            f"{name}: expected a controller of one number, such as a PID, a Hysteresis, a Schedule "
            f"or a number, got {kind}"
        )
    checked: Law | Signal = entry
    return checked


def _names_in(text: str) -> list[str]:
    """Names in a signal: names of an expression, or the whole text."""
    with suppress(ConfigError):
        return sorted(Expression.parse(text).names)
    return [text]
