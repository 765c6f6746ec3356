"""The warm-up of a declared task: controllers that act before an episode begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from fmugym.checks import Spellings, check_text, normal_form, number_of
from fmugym.declared.entries import Entry
from fmugym.declared.enumerations import check_controller
from fmugym.declared.variables import TaskVariable
from fmugym.errors import ConsequenceError, shown, unknown_name
from fmugym.expressions.language import Expression

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
    """What a controller measures, and its set point: names and other expressions."""
    given = (getattr(controller, name, None) for name in ("of", "setpoint"))
    return [name for name in given if isinstance(name, str)]


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
        controlled: What is measured and its set point, in pairs, for a thermostat.
        name_of: Returns a name as it is declared.
    """
    known = _named_controllers(root)
    entry = root.child("warm_up")
    if entry.value is None:
        return WarmUpTable(entry)
    controllers: dict[str, Controller] = {}
    for name, one in _by_action(entry.child("controller"), actions).items():
        with one.noting():
            variable = _action_of(one, name, actions)
            controllers[variable.alias] = controller = (
                _thermostat(one, variable, controlled)
                if one.value in THERMOSTATS and one.value not in known
                else _acting(one, known)
            )
            _rename(controller, name_of)
            check_controller(one, variable, controller)
    return WarmUpTable(
        entry, entry.value.get("period", 0.0), controllers, entry.value.get("cache", False)
    )


def _rename(controller: Controller, name_of: Callable[[str], str]) -> None:
    for key in ("of", "setpoint"):
        if isinstance(signal := getattr(controller, key, None), str) and signal.isidentifier():
            setattr(controller, key, name_of(signal))


def _named_controllers(root: Entry) -> dict[str, Entry]:
    """The controllers that a task names; each of them is checked, also one with ranges."""
    from fmugym.baselines.parsing import has_range, search_of

    known = root.child("controllers").items()
    for one in known.values():
        with one.noting():
            if has_range(one.value):
                search_of(one.value)
            else:
                _controller(one, {})
    return known


def _thermostat(
    entry: Entry, variable: TaskVariable, controlled: Sequence[tuple[str, str]]
) -> Controller:
    """A thermostat whose arguments the task tells: it heats with the highest action.

    Raises:
        ConfigError: If it is not known what to measure, or its set point. The text gives a
            controller to write instead.
    """
    from fmugym.baselines import Hysteresis

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


def _by_action(entry: Entry, actions: Sequence[TaskVariable]) -> dict[str, Entry]:
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


def _acting(entry: Entry, known: Mapping[str, Entry]) -> Controller:
    from fmugym.baselines import MPC

    controller = _controller(entry, known)
    if isinstance(controller, MPC):
        raise entry.error(
            "MPC plans with copies of the environment, which there are none of in a warm-up; "
            "take a pid, a hysteresis or a number"
        )
    return controller


def _controller(entry: Entry, known: Mapping[str, Entry]) -> Controller:
    from fmugym.baselines import Constant, controller_of

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
        for signal in signals_of(controller):
            Expression.parse(signal)
    return controller
