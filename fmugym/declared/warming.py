"""The warm-up of a declared task: controllers that act before an episode begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from fmugym.checks import check_text
from fmugym.declared.entries import Entry
from fmugym.declared.variables import Record
from fmugym.errors import shown, unknown_name

if TYPE_CHECKING:
    from fmugym.baselines import Controller

__all__ = ["WarmUpTable", "read_warm_up", "signals_of"]

THERMOSTATS: Final = ("thermostat", "hysteresis")
"""The names of a controller whose arguments the task may tell."""


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


def read_warm_up(
    root: Entry, actions: Sequence[Record], controlled: Sequence[tuple[str, str]]
) -> WarmUpTable:
    """Read the warm-up of a task.

    Args:
        root: The task.
        actions: Its actions.
        controlled: What is measured and its set point, in pairs, for a thermostat.

    Raises:
        ConfigError: If it has no period, or a controller of no action.
    """
    from fmugym.baselines import MPC

    known = _named_controllers(root)
    entry = root.child("warm_up")
    if entry.value is None:
        return WarmUpTable(entry)
    given = entry.child("controller")
    entries = {} if given.value is None else _by_action(given, actions)
    records = {record.alias: record for record in actions}
    controllers = {
        name: _thermostat(one, records[name], controlled)
        if _is_bare_thermostat(one, known)
        else _controller(one, known)
        for name, one in entries.items()
    }
    for name, one in entries.items():
        if isinstance(controllers[name], MPC):
            raise one.error(
                "MPC plans with copies of the environment, which there are none of in a warm-up; "
                "take a pid, a hysteresis or a number"
            )
    return WarmUpTable(entry, entry.value["period"], controllers, entry.value["cache"])


def _named_controllers(root: Entry) -> dict[str, Entry]:
    """The controllers that a task names; each of them is checked, also one with ranges."""
    from fmugym.baselines.parsing import has_range, search_of

    known = root.child("controllers").items()
    for one in known.values():
        if has_range(one.value):
            with one.placing():
                search_of(one.value)
        else:
            _controller(one, {})
    return known


def _is_bare_thermostat(entry: Entry, known: Mapping[str, Entry]) -> bool:
    return entry.value in THERMOSTATS and entry.value not in known


def _thermostat(entry: Entry, record: Record, controlled: Sequence[tuple[str, str]]) -> Controller:
    """A thermostat whose arguments the task tells: it heats with the highest action.

    Raises:
        ConfigError: If it is not known what to measure, or its set point. The text gives a
            controller to write instead.
    """
    from fmugym.baselines import Hysteresis

    low, high = record.range
    if len(controlled) == 1:
        (of, setpoint), *_ = controlled
        with entry.placing():
            return Hysteresis(of, setpoint, 0.0, below=high, above=low)
    of, setpoint = controlled[0] if controlled else ("T", "21")
    raise entry.error(
        f"{shown(entry.value)} alone needs one set point with the key 'of', and the task has "
        f"{len(controlled) or 'none'}; write for example "
        f'"hysteresis of={of} setpoint={setpoint} band=0.5 below={high:g} above={low:g}"'
    )


def _by_action(entry: Entry, actions: Sequence[Record]) -> dict[str, Entry]:
    names = [record.alias for record in actions]
    if isinstance(entry.value, Mapping):
        for name, one in entry.items().items():
            if name not in names:
                raise one.error(unknown_name("action", name, names))
        return entry.items()
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
    with entry.placing():
        text = check_text("controller", value)
        if known and len(text.split()) == 1:
            raise unknown_name("controller", text, known)
        controller = controller_of(text)
    for name in signals_of(controller):
        if not name.isidentifier():
            raise entry.error(f"{shown(name)} is no name of a variable; give it an alias")
    return controller
