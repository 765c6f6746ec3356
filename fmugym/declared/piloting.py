"""Controllers that act on the variables of a task before an episode begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from fmugym.declared.declarations import Declarations
from fmugym.declared.naming import Moment, Naming
from fmugym.declared.variables import TaskVariable
from fmugym.declared.warming import signals_of
from fmugym.distributions import Choice, is_distribution
from fmugym.errors import shown
from fmugym.expressions.by_numpy import function_of
from fmugym.expressions.graph import Graph, Node
from fmugym.expressions.language import Expression
from fmugym.expressions.value import Value
from fmugym.task.warm_up import WarmUp

if TYPE_CHECKING:
    from fmugym.baselines import Controller

__all__ = ["DeclaredWarmUp"]

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


class Pilot:
    """A controller and its action.

    Args:
        naming: Gives names their values.
        variable: The variable that the controller writes.
        controller: Chooses the value, in the unit of the task.

    Attributes:
        variable, controller: As given.
        place: The place of its action.
        values: What it measures.
    """

    def __init__(self, naming: Naming, variable: TaskVariable, controller: Controller) -> None:
        self.variable, self.controller, self._declared = variable, controller, naming.declared
        self.place = naming.declared.actions.index(variable)
        self._names = tuple(signals_of(controller))
        entry = naming.declared.warm_up.entry.child("controller")
        measured = map(Expression.parse, self._names)
        self.values = [naming.value(entry, one, Moment.SEEN).number for one in measured]
        self._signals, self._clock = function_of(self.values), function_of(naming.clock)
        self._present = function_of(naming.present(variable)) if variable.delta else None

    def bind(self, count: int, time_step: float) -> None:
        """Prepare for the warm-up of some environments.

        Raises:
            ConfigError: If the controller does not fit the action.
        """
        low, high = self.variable.range
        space = spaces.Box(np.float32(low), np.float32(high), (1,), np.float32)
        env = SimpleNamespace(
            num_envs=count, single_action_space=space, time_step=time_step, unphysical_keys=()
        )
        env.unwrapped = env.config = env
        self.controller.bind(env, self._names)

    def act(self, env: Any) -> Any:
        """Choose the next action, as the agent would write it, shape (M,)."""
        value = self._decided(env)
        if self._declared.is_physical:
            return value
        if self.variable.levels:
            order = np.argsort(self.variable.levels)  # the lower of two levels counts as nearer
            distances = np.abs(np.array(self.variable.levels)[order, None] - value)
            return order[distances.argmin(axis=0)]
        if self._present is not None:
            value = np.clip(value - self._present(env), -self.variable.delta, self.variable.delta)
        low, high = self.variable.chosen
        is_rescaled = self._declared.rescales
        return (value - (low + high) / 2) / ((high - low) / 2) if is_rescaled else value

    def _decided(self, env: Any) -> Any:
        """The value in the unit of the task; controllers work with numbers of float32."""
        from fmugym.baselines import Schedule

        one: Any = self.controller
        if isinstance(one, Schedule):
            return np.clip(one.at(self._clock(env)), *self.variable.limits)
        rows = np.empty((len(env.step_count), len(self._names)), np.float32)
        for place, signal in enumerate(self._signals(env)):
            rows[:, place] = signal
        return one.act(rows)[:, 0].astype(np.float64)


class DeclaredWarmUp(WarmUp):
    """The warm-up of a declared task.

    Args:
        naming: Gives names their values.
        inputs: The FMU's inputs.
        update: Writes episode variables when the FMU has stepped.
        written: These variables by name, and what is written.
        config: The config.

    Raises:
        ConfigError: If a controller does not fit, or states cannot be kept.
    """

    def __init__(
        self,
        naming: Naming,
        inputs: Sequence[Value],
        update: Hook,
        written: Mapping[str, Sequence[Value]],
        config: Mapping[str, Any],
    ) -> None:
        declared, table = naming.declared, naming.declared.warm_up
        self.steps, self._time_step = naming.warm_steps, naming.time_step
        self.caches = table.caches
        self._inputs, self._update = function_of(tuple(inputs)), update
        self.writes = tuple(written)
        self._pilots = [
            Pilot(naming, variable, table.controllers[variable.alias])
            for variable in declared.actions
            if variable.alias in table.controllers
        ]
        parts = [inputs, *(pilot.values for pilot in self._pilots), *written.values()]
        roots = [value.node for part in (*parts, [naming.clock]) for value in part]
        needed = naming.graph.needed(roots)
        self.depends_on = variables_in([naming.graph.nodes[number] for number in needed])
        told = [
            repr((one.variable.alias, type(one.controller), vars(one.controller)))
            for one in self._pilots
        ]
        content = repr((self.steps, self._time_step, told, _described(naming.graph, roots)))
        self.digest = sha256(content.encode()).hexdigest()
        with table.entry.placing():
            self.begin(1)  # which finds mistakes
        if self.caches:
            self._require_few_states(declared, config)

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
        self._update(env)

    def _require_few_states(self, declared: Declarations, config: Mapping[str, Any]) -> None:
        """Refuse to keep states that hardly any later episode could use."""
        parameters = {name: value for name, (_, value) in declared.parameters.items()}
        own = {name: config["episode_variables"][name] for name in self.depends_on}
        begin = {"start_time": config.get("start_time")}
        for name, value in (parameters | own | begin).items():
            if is_distribution(value) and not isinstance(value, Choice):
                raise declared.warm_up.entry.child("cache").error(
                    f"the state after the warm-up depends on {name!r}, which is drawn from "
                    f"{shown(value)}: nearly every episode needs a state of its own. Leave out "
                    "'cache', or draw from a list of values"
                )
