"""The warm-up of a declared task: controllers that act before an episode begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from fmugym.declared.entries import Entry
from fmugym.declared.quantities import duration
from fmugym.declared.variables import Record
from fmugym.errors import shown, unknown_name

if TYPE_CHECKING:
    from fmugym.baselines import Controller

__all__ = ["WARM_UP_KEYS", "WarmUpTable", "period_of", "read_warm_up", "signals_of"]

WARM_UP_KEYS: Final = ("period", "controller", "cache")
"""The keys of a warm-up."""


@dataclass(frozen=True)
class WarmUpTable:
    """What a task says about its warm-up.

    Attributes:
        entry: Where it stands.
        period: Its length in seconds.
        controllers: By the alias of an action, what acts on it; others keep their start values.
        caches: Whether to keep the state that it leads to.
    """

    entry: Entry
    period: float = 0.0
    controllers: Mapping[str, Controller] = field(default_factory=dict)
    caches: bool = False

    def signals(self) -> list[str]:
        """The names of what the controllers measure."""
        named = [name for one in self.controllers.values() for name in signals_of(one)]
        return list(dict.fromkeys(named))


def signals_of(controller: Controller) -> list[str]:
    """The names of what a controller measures, and of its set point."""
    given = (getattr(controller, name, None) for name in ("of", "setpoint"))
    return [name for name in given if isinstance(name, str)]


def period_of(entry: Entry) -> float:
    """The length of a warm-up in seconds; 0 if there is none."""
    if entry.value is None:
        return 0.0
    return (entry.required("period") if isinstance(entry.value, Mapping) else entry).check(duration)


def read_warm_up(root: Entry, actions: Sequence[Record]) -> WarmUpTable:
    """Read the warm-up of a task.

    Raises:
        ConfigError: If it has no period, or a controller of no action.
    """
    known = _named_controllers(root)
    entry = root.child("warm_up")
    if entry.value is None:
        return WarmUpTable(entry)
    period = period_of(entry)
    if not isinstance(entry.value, Mapping):
        return WarmUpTable(entry, period)
    table = entry.table(WARM_UP_KEYS)
    caches = "cache" in table and table["cache"].flag()
    given = table.get("controller")
    entries = {} if given is None else _by_action(given, actions)
    controllers = {name: _controller(one, known) for name, one in entries.items()}
    return WarmUpTable(entry, period, controllers, caches)


def _named_controllers(root: Entry) -> dict[str, Entry]:
    """The controllers that a task names; each of them is checked."""
    section = root.child("controllers")
    known = {} if section.value is None else section.items()
    for one in known.values():
        _controller(one, {})
    return known


def _by_action(entry: Entry, actions: Sequence[Record]) -> dict[str, Entry]:
    names = [record.alias for record in actions]
    if isinstance(entry.value, Mapping):
        return entry.table(names)
    if len(names) == 1:
        return {names[0]: entry}
    raise entry.error(f"name a controller for each action, such as {{ {names[0]} = 0 }}")


def _controller(entry: Entry, known: Mapping[str, Entry]) -> Controller:
    from fmugym.baselines import Constant, controller_of

    value = entry.value
    if isinstance(value, str) and value in known:
        return _controller(known[value], {})
    if isinstance(value, int | float) and not isinstance(value, bool):
        return Constant(float(value))
    text = entry.text()
    with entry.placing():
        if known and len(text.split()) == 1:
            raise unknown_name("controller", text, known)
        controller = controller_of(text)
    for name in signals_of(controller):
        if not name.isidentifier():
            raise entry.error(f"{shown(name)} is no name of a variable; give it an alias")
    return controller
