"""The key ``warm_up`` of a task: controllers that act before an episode begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from fmugym.checks import Spellings, check_text, normal_form, number_of
from fmugym.errors import ConsequenceError, shown, unknown_name
from fmugym.expressions.language import Expression
from fmugym.task.task_entries import Entry
from fmugym.task.task_variables import TaskVariable, check_items_of_controller

if TYPE_CHECKING:
    from fmugym.control import Controller, ControllerTable, Signal
    from fmugym.control.controller import Law

__all__ = ["WARM_UP_CLOCK", "WarmUpTable", "read_warm_up"]

WARM_UP_CLOCK: Final = "clock"
"""Name of the time that schedules of a warm-up read; it is not rounded as measured values are."""

_THERMOSTATS: Final = ("thermostat", "hysteresis")
"""The names of a controller whose arguments the task may tell."""


@dataclass(frozen=True)
class WarmUpTable:
    """Declaration of the warm-up of a task.

    Attributes:
        entry: Entry of the task.
        period: Its length in seconds.
        controllers: What acts on actions, by their aliases; others keep their start values. None if
            nothing acts.
        caches: Whether to keep the state that it leads to.
    """

    entry: Entry
    period: float = 0.0
    controllers: ControllerTable | None = None
    caches: bool = False

    @property
    def acting(self) -> list[str]:
        """The aliases of the actions on which something acts."""
        return [] if self.controllers is None else list(self.controllers.acting)

    def measured(self) -> list[str]:
        """Names and expressions that the controllers measure."""
        return [] if self.controllers is None else self.controllers.measured()


def read_warm_up(
    root: Entry,
    actions: Sequence[TaskVariable],
    controlled: Sequence[tuple[str, str]],
    name_of: Callable[[str], str],
) -> WarmUpTable:
    """Read the warm-up of a task, and note its mistakes, such as a controller of no action.

    Args:
        root: The task.
        actions: Its actions.
        controlled: Pairs of a measured value and its set point, for a thermostat.
        name_of: Returns a name as it is declared.
    """
    known = root.child("controllers").items()
    for one in known.values():
        with one.noting():
            if not one.mistakes.explain(one.keys):
                _require_controller(one, known)
    entry = root.child("warm_up")
    if entry.value is None:
        return WarmUpTable(entry)
    given = _by_action(entry.child("controller"), actions, known)
    found: dict[str, Any] = {}
    for name, one in given.items():
        with one.noting():
            if isinstance(one.value, Mapping):
                found[name] = _signal(one, known, name_of)
                continue
            variable = _action_of(one, name, actions)
            controller: Any = (
                _thermostat(one, variable, controlled)
                if one.value in _THERMOSTATS and one.value not in known
                else _acting(one, known)
            )
            _rename(controller, name_of)
            check_items_of_controller(one, variable, controller)
            found[variable.alias] = controller
    controllers = None
    if found and len(found) == len(given):
        with entry.child("controller").noting():
            controllers = _table(found)
    return WarmUpTable(
        entry, entry.value.get("period", 0.0), controllers, entry.value.get("cache", False)
    )


def _table(entries: Mapping[str, Any]) -> ControllerTable:
    """Controllers of the warm-up as a table; their schedules go by the clock."""
    from fmugym.control import ControllerTable, Schedule

    table = ControllerTable(entries)
    for law in table.laws():
        if isinstance(law, Schedule):
            law.clock = WARM_UP_CLOCK
    return table


def _signal(entry: Entry, known: Mapping[str, Entry], name_of: Callable[[str], str]) -> Signal:
    """A signal between controllers."""
    from fmugym.control import Signal

    controller = _acting(entry.required("controller"), known)
    _rename(controller, name_of)
    low, high = (entry.required(key).value for key in ("min", "max"))
    with entry.placing():
        return Signal(controller, low, high)


def _rename(controller: Law, name_of: Callable[[str], str]) -> None:
    for key in controller.signals:
        if isinstance(signal := getattr(controller, key), str) and signal.isidentifier():
            setattr(controller, key, name_of(signal))


def _require_controller(entry: Entry, known: Mapping[str, Entry]) -> None:
    """Check a controller that the task names, also one with ranges."""
    from fmugym.control import controller_of
    from fmugym.control.controller_parsing import has_range, search_of
    from fmugym.control.controller_table import is_table, resolved

    given = entry.value
    if is_table(given):
        given = resolved(given, {name: one.value for name, one in known.items()})
    if has_range(given):
        search_of(given)
    elif is_table(given):
        _require_expressions(controller_of(given))
    else:
        _controller(entry, {})


def _thermostat(
    entry: Entry, variable: TaskVariable, controlled: Sequence[tuple[str, str]]
) -> Controller:
    """A thermostat whose arguments the task tells: it heats with the highest action.

    Raises:
        ConfigError: If it is not known what to measure, or its set point. The text gives a
            controller to write instead.
    """
    from fmugym.control import Hysteresis

    low, high = variable.range
    if len(controlled) == 1:
        (of, setpoint), *_ = controlled
        with entry.placing():
            return Hysteresis(of, setpoint, 0.0, below=high, above=low)
    if any(map(entry.mistakes.explain, [("setpoints",), ("agent", "observations")])):
        raise ConsequenceError("what is controlled is not known")
    of, setpoint = controlled[0] if controlled else ("T", "21")
    raise entry.error(
        f"{shown(entry.value)} alone needs one set point with the key 'of', and the task has "
        f"{len(controlled) or 'none'}; write for example "
        f'"hysteresis of={of} setpoint={setpoint} band=0.5 below={high:g} above={low:g}"'
    )


def _by_action(
    entry: Entry, actions: Sequence[TaskVariable], known: Mapping[str, Entry]
) -> dict[str, Entry]:
    """The entries of a table, which may have a name; one entry if there is one action."""
    named = known.get(entry.value) if isinstance(entry.value, str) else None
    if named is not None and isinstance(named.value, Mapping):
        entry = named
    if entry.value is None or isinstance(entry.value, Mapping):
        return entry.items()
    names = [variable.alias for variable in actions]
    with entry.noting():
        _require_actions(entry)
        if len(names) > 1:
            raise entry.error(f"name a controller for each action, such as {{ {names[0]} = 0 }}")
    return dict.fromkeys(names, entry)


def _require_actions(entry: Entry) -> None:
    if entry.mistakes.explain(("agent", "actions")):
        raise ConsequenceError("the actions are not known")


def _action_of(entry: Entry, name: str, actions: Sequence[TaskVariable]) -> TaskVariable:
    for variable in actions:
        if normal_form(variable.alias) == normal_form(name):
            return variable
    _require_actions(entry)
    raise unknown_name("action", name, [variable.alias for variable in actions])


def _acting(entry: Entry, known: Mapping[str, Entry]) -> Any:
    from fmugym.control import MPC

    controller = _controller(entry, known)
    if isinstance(controller, MPC):
        raise entry.error(
            "MPC plans with copies of the environment, which there are none of in a warm-up; "
            "take a pid, a hysteresis or a number"
        )
    return controller


def _controller(entry: Entry, known: Mapping[str, Entry]) -> Controller:
    from fmugym.control import Constant, controller_of

    value = entry.value
    with entry.placing():
        own = Spellings("controller of the task", known).find(value)
    if own is not None:
        return _controller(known[own], {})
    if isinstance(value, int | float) and not isinstance(value, bool):
        with entry.placing():
            return Constant(number_of("controller", value))
    with entry.placing():
        text = check_text("controller", value)
        if known and len(text.split()) == 1:
            raise unknown_name("controller", text, known)
        controller = controller_of(text)
    with entry.placing():
        _require_expressions(controller)
    return controller


def _require_expressions(controller: Controller) -> None:
    """Check that the measured values of a controller are expressions."""
    from fmugym.control.controller import Law

    for signal in controller.measured() if isinstance(controller, Law) else ():
        Expression.parse(signal)
