"""Controllers of a warm-up, which act on the variables of a task before an episode begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from fmugym.environment.distributions import Choice, is_distribution
from fmugym.environment.reset import WarmUp
from fmugym.errors import shown
from fmugym.expressions.graph import Graph, Node, Value
from fmugym.expressions.language import Expression
from fmugym.expressions.numpy_evaluation import function_of
from fmugym.task.declarations import Declarations
from fmugym.task.task_names import Moment, Naming
from fmugym.task.task_variables import TaskVariable
from fmugym.task.warm_up_table import WARM_UP_CLOCK

if TYPE_CHECKING:
    from fmugym.control import ControllerTable

__all__ = ["DeclaredWarmUp"]

_Hook = Callable[[Any], Any]


def _variables_in(nodes: Sequence[Node]) -> tuple[str, ...]:
    """The episode variables that nodes read."""
    rows: list[Any] = [node.what for node in nodes if node.kind == "row"]
    found = (names[0] for attribute, *names in rows if attribute == "variables")
    return tuple(dict.fromkeys(found))


def _described(graph: Graph, roots: Sequence[int]) -> list[Any]:
    """Describe nodes of a graph by a text that is the same in every process."""
    order = graph.needed(roots)
    places = {number: place for place, number in enumerate(order)}
    described: list[Any] = [places[root] for root in roots]
    for number in order:
        kind, what, operands, dtype = graph.nodes[number]
        what = getattr(what, "__name__", what)
        table = graph.tables[what].tobytes() if kind in ("take", "interpolate") else b""
        described.append((kind, what, [places[one] for one in operands], dtype.str, table))
    return described


class WarmUpControllers:
    """The controllers of a warm-up and their actions.

    Args:
        naming: Gives names their values.
        controllers: Choose the values, in the units of the task.

    Attributes:
        controllers: As given.
        values: Measured values.
    """

    def __init__(self, naming: Naming, controllers: ControllerTable) -> None:
        self.controllers, self._declared = controllers, naming.declared
        actions = naming.declared.actions
        self._variables = {
            place: variable
            for place, variable in enumerate(actions)
            if variable.alias in controllers.acting
        }
        self._names = tuple(controllers.measured())
        self._is_measured = np.array([name != WARM_UP_CLOCK for name in self._names], dtype=bool)
        entry = naming.declared.warm_up.entry.child("controller")
        measured = map(Expression.parse, self._names)
        self.values = [naming.value(entry, one, Moment.SEEN).number for one in measured]
        self._read = function_of(self.values)
        self._present = {
            place: function_of(naming.present(variable))
            for place, variable in self._variables.items()
            if variable.delta
        }

    def bind(self, count: int, time_step: float) -> None:
        """Prepare for the warm-up of some environments.

        Raises:
            ConfigError: If a controller does not fit its action.
        """
        low, high = np.array([one.range for one in self._variables.values()], np.float32).T
        names = tuple(variable.alias for variable in self._variables.values())
        space = spaces.Box(low, high, dtype=np.float32)
        self.controllers.attach(space, self._names, names, time_step, count)

    def act(self, env: Any) -> dict[int, Any]:
        """Choose the next actions, as the agent would write them: by place, shape (M,)."""
        chosen = self.controllers.act(self._rows(env)).astype(np.float64).T
        pairs = zip(self._variables.items(), chosen, strict=True)
        return {
            place: self._as_agent(env, place, variable, value) for (place, variable), value in pairs
        }

    def _rows(self, env: Any) -> Any:
        """Measured values, rounded to float32 as controllers read them."""
        rows = np.empty((len(env.step_count), len(self._names)))
        for place, signal in enumerate(self._read(env)):
            rows[:, place] = signal
        rows[:, self._is_measured] = rows[:, self._is_measured].astype(np.float32)
        return rows

    def _as_agent(self, env: Any, place: int, variable: TaskVariable, value: Any) -> Any:
        """A value in the unit of the task in the form in which the agent writes it."""
        if self._declared.is_physical:
            return value
        if variable.levels:
            order = np.argsort(variable.levels)  # the lower of two levels counts as nearer
            distances = np.abs(np.array(variable.levels)[order, None] - value)
            nearest = distances.argmin(axis=0)
            if self._declared.are_choices:
                return order[nearest]
            low, high = self._declared.range_of(variable)
            return low + (high - low) * (nearest + 0.5) / len(order)
        if place in self._present:
            value = np.clip(value - self._present[place](env), -variable.delta, variable.delta)
        low, high = variable.chosen
        is_rescaled = self._declared.rescales
        return (value - (low + high) / 2) / ((high - low) / 2) if is_rescaled else value


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
        update: _Hook,
        written: Mapping[str, Sequence[Value]],
        config: Mapping[str, Any],
    ) -> None:
        declared, table = naming.declared, naming.declared.warm_up
        self.steps, self._time_step = naming.warm_steps, naming.time_step
        self.caches = table.caches
        self._inputs, self._update = function_of(tuple(inputs)), update
        self.writes = tuple(written)
        self._controllers = (
            None if table.controllers is None else WarmUpControllers(naming, table.controllers)
        )
        measured = [] if self._controllers is None else self._controllers.values
        parts = [inputs, measured, *written.values()]
        roots = [value.node for part in (*parts, [naming.clock]) for value in part]
        needed = naming.graph.needed(roots)
        self.depends_on = _variables_in([naming.graph.nodes[number] for number in needed])
        told = None if table.controllers is None else table.controllers.told()
        content = repr((self.steps, self._time_step, told, _described(naming.graph, roots)))
        self.digest = sha256(content.encode()).hexdigest()
        with table.entry.placing():
            self.begin(1)  # which finds mistakes
        if self.caches:
            self._require_few_states(declared, config)

    def begin(self, count: int) -> None:
        """See ``WarmUp.begin``."""
        if self._controllers is not None:
            self._controllers.bind(count, self._time_step)

    def inputs(self, env: Any) -> Any:
        """See ``WarmUp.inputs``; the controllers act first."""
        env.action = np.array(env.action)
        chosen = {} if self._controllers is None else self._controllers.act(env)
        for place, value in chosen.items():
            env.action[place if env.action.ndim > 1 else ...] = value
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
