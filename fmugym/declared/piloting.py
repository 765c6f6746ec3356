"""Controllers that act on the variables of a task before an episode begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from gymnasium import spaces

from fmugym.declared.computed import Value, function_of
from fmugym.declared.declarations import Declarations
from fmugym.declared.expressions import Expression
from fmugym.declared.naming import Moment, Naming
from fmugym.declared.observing import History
from fmugym.declared.variables import TaskVariable
from fmugym.declared.warming import signals_of
from fmugym.distributions import Choice, is_distribution
from fmugym.errors import shown
from fmugym.task.warm_up import WarmUp
from fmugym.vector.hooks.graph import Graph, Node

if TYPE_CHECKING:
    from fmugym.baselines import Controller

__all__ = ["DeclaredWarmUp", "WarmUpMaker"]

Hook = Callable[[Any], Any]


def variables_in(nodes: Sequence[Node]) -> tuple[str, ...]:
    """The episode variables that nodes read."""
    rows: list[Any] = [node.what for node in nodes if node.kind == "row"]
    found = (names[0] for attribute, *names in rows if attribute == "variables")
    return tuple(dict.fromkeys(found))


def _described(graph: Graph, roots: Sequence[int]) -> list[Any]:
    """What nodes of a graph compute, in a form that is the same in every process."""
    order = graph.needed(roots)
    places = {number: place for place, number in enumerate(order)}
    described: list[Any] = [places[root] for root in roots]
    for number in order:
        kind, what, operands, dtype = graph.nodes[number]
        what = getattr(what, "__name__", what)
        table = graph.tables[what].tobytes() if kind in ("take", "interpolate") else b""
        described.append((kind, what, [places[one] for one in operands], dtype.str, table))
    return described


class Pilot(NamedTuple):
    """A controller and its action.

    Attributes:
        variable: The variable that it writes.
        place: The place of its action.
        controller: Chooses the value, in the unit of the task.
        names: What it measures.
        signals: A function of the environment that returns these values.
        clock: A function of the environment that returns the time of data.
        present: A function that returns the value that is written now, for an action that is a
            change; otherwise None.
        rescales: Whether actions go from -1 to 1.
        is_physical: Whether actions are values in the unit of the task.
    """

    variable: TaskVariable
    place: int
    controller: Controller
    names: tuple[str, ...]
    signals: Hook
    clock: Hook
    present: Hook | None
    rescales: bool
    is_physical: bool

    def bind(self, count: int, time_step: float) -> None:
        """Prepare for the warm-up of some environments.

        Raises:
            ConfigError: If the controller does not fit the action.
        """
        low, high = self.variable.range
        space = spaces.Box(np.float32(low), np.float32(high), (1,), np.float32)
        self.controller.bind(_Many(count, space, time_step), self.names)

    def act(self, env: Any) -> Any:
        """Choose the next action, as the agent would write it, shape (M,)."""
        value = self._decided(env)
        if self.is_physical:
            return value
        if self.variable.levels:
            order = np.argsort(self.variable.levels)  # the lower of two levels counts as nearer
            distances = np.abs(np.array(self.variable.levels)[order, None] - value)
            return order[distances.argmin(axis=0)]
        if self.present is not None:
            value = np.clip(value - self.present(env), -self.variable.delta, self.variable.delta)
        return self._rescaled(value)

    def _decided(self, env: Any) -> Any:
        """The value in the unit of the task; controllers work with numbers of float32."""
        from fmugym.baselines import Schedule

        one: Any = self.controller
        if isinstance(one, Schedule):
            return np.clip(one.at(self.clock(env)), self.variable.low, self.variable.high)
        rows = np.empty((len(env.step_count), len(self.names)), np.float32)
        for place, signal in enumerate(self.signals(env)):
            rows[:, place] = signal
        return one.act(rows)[:, 0].astype(np.float64)

    def _rescaled(self, value: Any) -> Any:
        variable = self.variable
        if not self.rescales:
            return value
        low, high = (
            (-variable.delta, variable.delta) if variable.delta else (variable.low, variable.high)
        )
        return (value - (low + high) / 2) / ((high - low) / 2)


class _Many:
    """Some environments with one action, as controllers look at them."""

    unphysical_keys = ()

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
        values: All values that these functions return.
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
        values: Sequence[Value],
        writes: tuple[str, ...],
        caches: bool,
    ) -> None:
        self.steps, self._time_step = steps, time_step
        self._pilots, self._inputs, self._updates = pilots, inputs, updates
        self.writes, self.caches = writes, caches
        graph, roots = values[0].graph, [value.node for value in values]
        self.depends_on = variables_in([graph.nodes[number] for number in graph.needed(roots)])
        told = [repr((p.variable.alias, type(p.controller), vars(p.controller))) for p in pilots]
        content = repr((steps, time_step, told, _described(graph, roots)))
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
            env.action[pilot.place if env.action.ndim > 1 else ...] = pilot.act(env)
        return self._inputs(env)

    def update(self, env: Any) -> None:
        """See ``WarmUp.update``."""
        for update in self._updates:
            update(env)


class WarmUpMaker:
    """Makes the warm-up of a task.

    Args:
        declared: The task.
        naming: Gives names their values.
        time_step: Length of a step in seconds.
    """

    def __init__(self, declared: Declarations, naming: Naming, time_step: float) -> None:
        self._declared, self._naming, self._time_step = declared, naming, time_step

    def make(
        self,
        steps: int,
        inputs: Sequence[Value],
        updates: Sequence[Hook],
        histories: Sequence[History],
        switches: Mapping[str, Value],
        variables: Mapping[str, Any],
        start_time: Any,
    ) -> DeclaredWarmUp:
        """Make the warm-up.

        Args:
            steps: Its steps.
            inputs: The FMU's inputs.
            updates: Functions that write histories and what ``switches`` has.
            histories: The histories that are written.
            switches: The new values of other episode variables by name.
            variables: All episode variables of the config.
            start_time: That of the config.

        Raises:
            ConfigError: If a controller does not fit, or states cannot be kept.
        """
        table = self._declared.warm_up
        pilots = [self._pilot(variable) for variable in self._declared.actions]
        kept = [value for history in histories for value in (history.now, history.fill)]
        signals = [self._signal(name) for name in table.signals()]
        with table.entry.placing():
            warm_up = DeclaredWarmUp(
                steps,
                self._time_step,
                [pilot for pilot in pilots if pilot is not None],
                function_of(tuple(inputs)),
                updates,
                [*inputs, *signals, *switches.values(), *kept, self._naming.clock],
                (*(history.variable for history in histories), *switches),
                table.caches,
            )
        if table.caches:
            self._require_few_states(warm_up, variables, start_time)
        return warm_up

    def _require_few_states(
        self, warm_up: DeclaredWarmUp, variables: Mapping[str, Any], start_time: Any
    ) -> None:
        """Refuse to keep states that hardly any later episode could use."""
        begin = {"start_time": start_time}
        parameters = {name: value for name, (_, value) in self._declared.parameters.items()}
        own = {name: variables[name] for name in warm_up.depends_on}
        for name, value in (parameters | own | begin).items():
            if is_distribution(value) and not isinstance(value, Choice):
                raise self._declared.warm_up.entry.child("cache").error(
                    f"the state after the warm-up depends on {name!r}, which is drawn from "
                    f"{shown(value)}: nearly every episode needs a state of its own. Leave out "
                    "'cache', or draw from a list of values"
                )

    def _pilot(self, variable: TaskVariable) -> Pilot | None:
        controller = self._declared.warm_up.controllers.get(variable.alias)
        if controller is None:
            return None
        names = signals_of(controller)
        present = function_of(self._naming.present(variable)) if variable.delta else None
        return Pilot(
            variable,
            self._declared.actions.index(variable),
            controller,
            tuple(names),
            function_of(tuple(map(self._signal, names))),
            function_of(self._naming.clock),
            present,
            self._declared.rescales,
            self._declared.is_physical,
        )

    def _signal(self, name: str) -> Value:
        entry = self._declared.warm_up.entry.child("controller")
        expression = Expression.parse(name)
        return self._naming.value(entry, expression, Moment.SEEN).number
