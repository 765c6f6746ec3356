"""The warm-up of a declared task: controllers that act before an episode begins."""

from __future__ import annotations

import re
from ast import literal_eval
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.declared.entries import Entry
from fmugym.declared.quantities import duration
from fmugym.declared.variables import Record
from fmugym.errors import unknown_name
from fmugym.task.warm_up import WarmUp

if TYPE_CHECKING:
    from fmugym.baselines import Controller

__all__ = ["WARM_UP_KEYS", "DeclaredWarmUp", "Pilot", "WarmUpTable", "read_warm_up", "variables_in"]

WARM_UP_KEYS: Final = ("period", "controller", "cache")
"""The keys of a warm-up."""

_VARIABLE: Final = re.compile(r"""env\.variables\[('[^']*'|"[^"]*")\]""")

Hook = Callable[[Any], Any]


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


def read_warm_up(root: Entry, actions: Sequence[Record]) -> WarmUpTable:
    """Read the warm-up of a task.

    Raises:
        ConfigError: If it has no period, or a controller of no action.
    """
    known = _named_controllers(root)
    entry = root.child("warm_up")
    if entry.value is None:
        return WarmUpTable(entry)
    if not isinstance(entry.value, Mapping):
        return WarmUpTable(entry, entry.check(duration))
    table = entry.table(WARM_UP_KEYS)
    period = entry.required("period").check(duration)
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
        return controller_of(text)


def variables_in(codes: Sequence[str]) -> tuple[str, ...]:
    """The episode variables that code reads."""
    found = (literal_eval(text) for code in codes for text in _VARIABLE.findall(code))
    return tuple(dict.fromkeys(found))


class Pilot(NamedTuple):
    """A controller and its action.

    Attributes:
        record: The variable that it writes.
        place: The place of its action.
        controller: Chooses the value, in the unit of the task.
        names: What it measures.
        signals: A function of the environment that returns these values.
        clock: A function of the environment that returns the time of data.
        present: A function that returns the value that is written now, for an action that is a
            change; otherwise None.
        rescales: Whether actions go from -1 to 1.
    """

    record: Record
    place: int
    controller: Controller
    names: tuple[str, ...]
    signals: Hook
    clock: Hook
    present: Hook | None
    rescales: bool

    def bind(self, count: int, time_step: float) -> None:
        """Prepare for the warm-up of some environments.

        Raises:
            ConfigError: If the controller does not fit the action.
        """
        record = self.record
        low, high = (record.low, record.high)
        if record.levels:
            low, high = min(record.levels), max(record.levels)
        space = spaces.Box(np.float32(low), np.float32(high), (1,), np.float32)
        self.controller.bind(_Many(count, space, time_step), self.names)

    def act(self, env: Any) -> Any:
        """Choose the next action, as the agent would write it, shape (M,)."""
        count = len(env.step_count)
        parts = [np.broadcast_to(value, (count,)) for value in self.signals(env)]
        rows = np.array(parts, np.float32).reshape(len(parts), count).T
        value = self._decided(env, rows)
        if self.record.levels:
            distance = np.abs(np.array(self.record.levels)[:, None] - value)
            return distance.argmin(axis=0)
        if self.present is not None:
            value = np.clip(value - self.present(env), -self.record.delta, self.record.delta)
        return self._rescaled(value)

    def _decided(self, env: Any, rows: npt.NDArray[np.float32]) -> Any:
        from fmugym.baselines import Schedule

        if isinstance(self.controller, Schedule):
            return np.clip(self.controller.at(self.clock(env)), self.record.low, self.record.high)
        return self.controller.act(rows)[:, 0].astype(np.float64)

    def _rescaled(self, value: Any) -> Any:
        record = self.record
        if not self.rescales:
            return value
        low, high = (-record.delta, record.delta) if record.delta else (record.low, record.high)
        return (value - (low + high) / 2) / ((high - low) / 2)


class _Many:
    """Some environments with one action, as controllers look at them."""

    def __init__(self, count: int, space: spaces.Box, time_step: float) -> None:
        self.num_envs, self.single_action_space, self.time_step = count, space, time_step

    @property
    def unwrapped(self) -> _Many:
        return self

    config = unwrapped


class DeclaredWarmUp(WarmUp):
    """The warm-up of a declared task.

    Args:
        steps: Its steps.
        time_step: Their length in seconds.
        pilots: What acts.
        inputs: A function of the environment that returns the FMU's inputs.
        updates: Functions that write episode variables when the FMU has stepped.
        codes: All code that these functions consist of.
        constants: The tables that the code reads.
        writes: The episode variables that are written.
        caches: Whether to keep the states that it leads to.
    """

    def __init__(
        self,
        steps: int,
        time_step: float,
        pilots: Sequence[Pilot],
        inputs: Hook,
        updates: Sequence[Hook],
        codes: Sequence[str],
        constants: Mapping[str, Any],
        writes: tuple[str, ...],
        caches: bool,
    ) -> None:
        self.steps, self._time_step = steps, time_step
        self._pilots, self._inputs, self._updates = pilots, inputs, updates
        self.writes, self.caches = writes, caches
        self.depends_on = variables_in(codes)
        told = [repr((p.record.alias, type(p.controller), vars(p.controller))) for p in pilots]
        tables = [(n, np.asarray(v).tobytes()) for n, v in sorted(constants.items())]
        content = repr((steps, time_step, told, list(codes), tables))
        self.digest = sha256(content.encode()).hexdigest()
        self.begin(1)  # which finds mistakes

    def begin(self, count: int) -> None:
        """See ``WarmUp.begin``."""
        for pilot in self._pilots:
            pilot.bind(count, self._time_step)

    def inputs(self, env: Any) -> Any:
        """See ``WarmUp.inputs``; the controllers act first."""
        env.previous_action, env.action = env.action, np.array(env.action)
        for pilot in self._pilots:
            place = pilot.place if env.action.ndim > 1 else ...
            env.action[place] = pilot.act(env)
        return self._inputs(env)

    def update(self, env: Any) -> None:
        """See ``WarmUp.update``."""
        for update in self._updates:
            update(env)
