"""Logic around the network of an agent: features from measurements, inputs from actions.

It consists of the formulas of the task, and between them of those of the agent. Between two samples
a controller knows its measurements and what it has kept: earlier measurements, actions and inputs,
the episode variables that the task writes, and what the agent remembers. External data are given at
run time: measured weather, forecasts, prices.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import Spellings
from fmugym.deployment.export.decision import Decision
from fmugym.deployment.export.identifiers import identifier
from fmugym.deployment.export.imperfections import without_imperfections
from fmugym.environment.actions import no_action
from fmugym.environment.env import FMUEnv
from fmugym.environment.hooks import is_overridden
from fmugym.environment.vector.task_programs import Translation, written_variables
from fmugym.errors import ConfigError
from fmugym.expressions.graph import Formulas, Graph, Node, Value
from fmugym.expressions.program import UncompilableError
from fmugym.fmi.variable import Variable
from fmugym.task import TaskEnv
from fmugym.task.declarations import Declarations

__all__ = ["Kept", "Logic", "Parameter", "found_in", "logic_of"]


def found_in(
    env: FMUEnv, names: Collection[str], graph: Graph, observation: Sequence[int]
) -> dict[int, Variable]:
    """Find the values of data in an observation, now or at other times.

    Args:
        env: The environment of a task file.
        names: The names of the data.
        graph: The operations.
        observation: The nodes of the elements of the observation.

    Returns:
        What takes the place of each, by the node that would look it up. Names differ from those of
        the plant's inputs.

    Raises:
        ConfigError: If there are no such data, or the agent does not observe them.
    """
    if not names:
        return {}
    seen = env.observation_names if isinstance(env, TaskEnv) else None
    if not isinstance(env, TaskEnv) or seen is None:
        raise ConfigError("only what a task file observes can be given to the agent from outside")
    series = Declarations(env.task.root, env.fmu.description).series
    spellings, found = Spellings("data", series), {}
    for name in map(spellings.require, names):
        places = [i for i, text in enumerate(seen) if text.partition("[")[0] == name]
        if not places:
            raise ConfigError(f"the agent does not observe {name!r}, so that nobody need give it")
        for place in places:
            node = _lookup_in(graph, observation[place], series[name])
            found[node] = _variable(seen[place], series[name], env)
    return found


def _lookup_in(graph: Graph, root: int, series: Any) -> int:
    for number in reversed(graph.needed([root])):
        node = graph.nodes[number]
        if node.kind == "interpolate" and np.array_equal(
            graph.tables[node.what][:-2], series.points
        ):
            return number
    raise ConfigError("data that do not change cannot be given from outside")


def _variable(name: str, series: Any, env: FMUEnv) -> Variable:
    facts: Mapping[str, Any] = {
        "value_reference": 0,
        "causality": "input",
        "variability": "continuous",
        "initial": None,
        "start": repr(float(series.values[0])),
        "unit": series.unit,
        "description": f"{name} of the task",
    }
    own, taken = identifier(name), env.interface.input_names
    kind = "Float64" if env.fmu.description.fmi_version.startswith("3") else "Real"
    return Variable(f"{own}_given" if own in taken else own, kind, **facts)


Load = tuple[Any, ...]
"""Source of a value: ``("measurement", i)``, ``("kept", field, i)``, ``("count",)``,
``("active",)``, ``("given", i)`` by the network, or ``("constant", value)``."""

_GIVEN: Final = "given"
_ANY_ACTION: Final = "any action"
_SEED: Final = 0
_OF_ANY: Final = Decision()


@dataclass(frozen=True)
class Kept:
    """Values that the controller keeps from one sample to the next.

    Attributes:
        name: What they are.
        dtype: Their type.
        starts: What they are before the first sample; for ``previous`` that sample counts.
        updates: For each the node of its next value; empty if they stay.
    """

    name: str
    dtype: np.dtype[Any]
    starts: tuple[Any, ...]
    updates: tuple[int, ...]


@dataclass(frozen=True)
class Parameter:
    """A number that was drawn in each episode, and that the user of the controller sets.

    Attributes:
        name: Its name in the task.
        field: The number of the ``Kept`` that holds it.
        element: Its place there.
        start: The value if nothing else is set.
        variable: The plant's variable, or ``START_TIME``; None for an episode variable.
    """

    name: str
    field: int
    element: int
    start: float
    variable: Variable | None


@dataclass(frozen=True)
class Logic:
    """The program around the network.

    Attributes:
        graph: The operations.
        loads: Sources of loaded values, by node.
        measurements: The plant's outputs that it reads.
        inputs: The plant's inputs that it writes.
        input_nodes: The node of each.
        features: The nodes of what the network takes; none if there is no network.
        kept: Kept values.
        parameters: Drawn parameters of each episode.
        time_step: From one sample to the next, in seconds.
    """

    graph: Graph
    loads: Mapping[int, Load]
    measurements: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    input_nodes: tuple[int, ...]
    features: tuple[int, ...]
    kept: tuple[Kept, ...]
    parameters: tuple[Parameter, ...]
    time_step: float

    @property
    def roots(self) -> list[int]:
        """The nodes that one sample is for."""
        updates = (node for kept in self.kept for node in kept.updates)
        return [*self.features, *self.input_nodes, *updates]


def logic_of(
    env: FMUEnv,
    decision: Decision = _OF_ANY,
    *,
    all_inputs: bool = False,
    external: Collection[str] = (),
) -> Logic:
    """Make the logic between measurements and inputs, without the network.

    Args:
        env: The environment. It is not stepped. What its sensors and actuators do is left out; see
            ``without_imperfections``.
        decision: From the observation to the action; by default any action may follow.
        all_inputs: Whether the controller also writes inputs that no action changes, such as the
            weather that the task feeds to the plant.
        external: The names of data that the controller is given as measurements, forecasts of
            them included, instead of looking them up in the task's tables.

    Raises:
        ConfigError: If a hook of the task is a function of Python, or reads what a controller does
            not have, or the network is for another task. The text names the hook or the value.
    """
    with without_imperfections(env) as ideal:
        return _logic_of_ideal(ideal, decision, all_inputs, external)


def _logic_of_ideal(
    env: FMUEnv, decision: Decision, all_inputs: bool, external: Collection[str]
) -> Logic:
    for name in ("step", "reset"):
        if is_overridden(env, name):
            raise ConfigError(f"{type(env).__name__} cannot be exported: {name} is overridden")
    if not isinstance(env.action_space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete):
        raise ConfigError(
            "an agent with a Box, Discrete or MultiDiscrete of actions can be exported, got "
            f"{env.action_space}"
        )
    try:
        sample = _Sample(env, _formulas_of(env), decision)
        return _Assembly(env, sample, decision, all_inputs, external).logic()
    except UncompilableError as error:
        raise ConfigError(f"{type(env).__name__} cannot be exported: {error}") from None


_KEYS: Final[Mapping[str, str]] = {
    "_get_inputs": "inputs",
    "_update": "memory",
    "_get_observation": "observations",
}
"""The hooks that are between measurements and inputs, and the keys of their formulas."""


def _formulas_of(env: FMUEnv) -> Formulas:
    """Formulas of a task; formulas of hooks that no controller needs may be missing.

    Raises:
        ConfigError: If a hook is a function of Python.
    """
    for hook, key in _KEYS.items():
        if is_overridden(env, hook):
            raise ConfigError(
                f"{type(env).__name__} cannot be exported: its hook {hook} is a function of "
                f"Python; write expressions under the key {key!r} instead"
            )
    return env.formulas or Formulas(Graph(), None, (), None, None, None, None, {})


class _Sample:
    """One sample of a controller in a single graph.

    Args:
        env: The environment.
        formulas: Formulas of its task.
        decision: Decision of the agent.

    Attributes:
        graph: The operations.
        observation, features, action: The nodes of each; features are what a network takes.
        inputs: The nodes of the FMU's inputs.
        are_chosen: Which of the inputs any action changes.
        updates: The nodes of what is remembered then, by name.
    """

    def __init__(self, env: FMUEnv, formulas: Formulas, decision: Decision) -> None:
        self.graph = Graph()
        self.features: tuple[int, ...] = ()
        self._env, self._formulas, self._decision = env, formulas, decision
        has_stepped = Value(self.graph, self.graph.load("active", None, np.dtype(np.bool_)))
        variables = written_variables(env, self.graph, formulas.updates, has_stepped)
        observed = Translation(env, self.graph, True, variables).observation(formulas)
        self.observation = _nodes(observed)
        action, memory = self._decided(observed)
        self.action = _nodes(action)
        dtype = env.action_space.dtype
        unknown = [self._row(_ANY_ACTION, i, dtype=dtype) for i in range(len(action))]
        any_action = set(_nodes(unknown))
        self.are_chosen = [
            not any_action.isdisjoint(self.graph.needed([node]))
            for node in self._inputs_after(unknown, variables)
        ]
        self.inputs = self._inputs_after(action, variables)
        remembered = zip(decision.starts, map(_nodes, memory), strict=True)
        self.updates = defaultdict[str, tuple[int, ...]](tuple, remembered)
        for (_, name, *_), value in variables.items():
            self.updates[name] += (value.node,)

    def _row(self, *what: Any, dtype: Any = np.float64) -> Value:
        return Value(self.graph, self.graph.load("row", what, dtype))

    def _decided(
        self, observation: Sequence[Value]
    ) -> tuple[Sequence[Value], Sequence[Sequence[Value]]]:
        """Action of a sample, and the memory of the agent after it."""
        memory = [
            [self._row("before", name, index) for index in range(start.size)]
            for name, start in self._decision.starts.items()
        ]
        action, then = self._decision.decide(observation, memory, self._asked)
        dtype = np.dtype(self._env.action_space.dtype)
        return [observation[0].beside(one).cast(dtype) for one in action], then

    def _asked(self, features: Sequence[Value]) -> list[Value]:
        """The last values of the network for some features, or any action if there is no network.

        What the first layer takes is noted.
        """
        network, space = self._decision.network, self._env.action_space
        count, dtype = math.prod(space.shape or ()), np.dtype(space.dtype)
        if network is not None:
            network.require_fitting(len(features), space)
            count, dtype = sum(network.parts), network.dtype
            features = [one.cast(dtype) for one in network.scaled(features)]
        self.features = _nodes(features)
        return [self._row(_GIVEN, index, dtype=dtype) for index in range(count)]

    def _inputs_after(
        self, action: Sequence[Value], variables: Mapping[Any, Value]
    ) -> tuple[int, ...]:
        """The nodes of the inputs if some action is chosen now."""
        last = Translation(self._env, self.graph, False)
        actions = {("action", index): one for index, one in enumerate(action)}
        actions |= {
            ("previous_action", index): last.quantity("action", index)
            for index in range(len(action))
        }
        values = Translation(self._env, self.graph, False, {**variables, **actions})
        return _nodes(values.inputs(self._formulas))


def _row_of(node: Node) -> Any:
    """Row that a node loads; a variable has the same row between two samples."""
    row: Any = node.what
    return ("before", *row[1:]) if row[0] == "variable" else row


def _nodes(values: Iterable[Value]) -> tuple[int, ...]:
    return tuple(value.node for value in values)


class _Assembly:
    """Makes a ``Logic`` of a sample, and keeps only the nodes on which the actions depend."""

    def __init__(
        self,
        env: FMUEnv,
        sample: _Sample,
        decision: Decision,
        all_inputs: bool,
        external: Collection[str],
    ) -> None:
        self._env, self._sample, self._graph = env, sample, sample.graph
        rng = np.random.default_rng(_SEED)
        self._episode = env.episode_start.draw(rng)
        self._starts = {**self._episode.variables, **decision.starts}
        self._drawn = set(env.episode_start.drawn_names)
        self._external = found_in(env, external, self._graph, sample.observation)
        rows = zip(env.interface.inputs, sample.inputs, sample.are_chosen, strict=True)
        self._inputs = [
            (variable, node) for variable, node, is_chosen in rows if all_inputs or is_chosen
        ]
        if not self._inputs:
            raise ConfigError(f"the actions of {type(env).__name__} change no input of the FMU")
        self._kept: list[Kept] = []
        self._fields: dict[str, int] = {}
        self._parameters: list[Parameter] = []

    def logic(self) -> Logic:
        """Find all that the features and the inputs depend on, from sample to sample."""
        roots = [*self._sample.features, *(node for _, node in self._inputs)]
        needed = set(self._graph.needed(roots, self._external))
        while True:
            found = [*roots, *self._next_values(needed)]
            longer = set(self._graph.needed(found, self._external))
            if longer == needed:
                break
            needed = longer
        places = self._measured(needed)
        self._add_fields(needed, places)
        updates = (node for kept in self._kept for node in kept.updates)
        numbers = sorted(needed.union(updates))
        loads = {n: load for n in numbers if (load := self._load(n, places)) is not None}
        interface = self._env.interface
        outputs = interface.outputs + interface.monitors
        return Logic(
            self._graph,
            loads,
            (*(outputs[place] for place in places), *self._external.values()),
            tuple(variable for variable, _ in self._inputs),
            tuple(node for _, node in self._inputs),
            self._sample.features,
            tuple(self._kept),
            tuple(self._parameters),
            interface.time_step,
        )

    def _reads(self, needed: Iterable[int]) -> defaultdict[str, list[Any]]:
        """Rows and elements of actions that some nodes read, by kind."""
        found = defaultdict(list)
        for number in sorted(needed):
            node = self._graph.nodes[number]
            kind, *what = _row_of(node) if node.kind == "row" else (node.kind, node.what)
            found[kind].append(what)
        return found

    def _next_values(self, needed: Iterable[int]) -> Iterator[int]:
        """Nodes of the values that are kept for the next sample."""
        reads = self._reads(needed)
        for name, *_ in reads["before"]:
            yield from self._sample.updates.get(name, ())
        if reads["input"]:
            yield from self._sample.inputs
        if reads["action"] or reads["previous_action"]:
            yield from self._sample.action

    def _measured(self, needed: Iterable[int]) -> list[int]:
        """The places of the values that are measured now, or were at the sample before."""
        reads = self._reads(needed)
        places = sorted({place for (place,) in (*reads["output"], *reads["kept"])})
        interface = self._env.interface
        for place in places:
            variable = (interface.outputs + interface.monitors)[place]
            if variable.causality != "output":
                raise UncompilableError(
                    f"it needs {variable.name!r}, which is no output of the FMU (its causality is "
                    f"{variable.causality!r}), so that no controller can measure it"
                )
        return places

    # Kept values.

    def _add_fields(self, needed: set[int], places: list[int]) -> None:
        reads = self._reads(needed)
        if reads["kept"]:
            outputs = [self._output_node(place) for place in places]
            self._add("previous", np.dtype(np.float64), [0.0] * len(places), outputs)
        if reads["input"]:
            self._add("inputs", np.dtype(np.float64), self._first_inputs(), self._sample.inputs)
        if reads["action"] or reads["previous_action"]:
            self._add_actions(has_older=bool(reads["previous_action"]))
        read, given = ({name for name, *_ in reads[kind]} for kind in ("before", "parameter"))
        for name in self._starts:  # those that never change are constants
            if name in read and (name in self._sample.updates or name in self._drawn):
                self._add_variable(name)
        for name in self._episode.parameters:
            if name in given and name in self._drawn:
                self._add_parameter(name)

    def _output_node(self, place: int) -> int:
        """The node of a measurement, which the graph gets if it has none yet."""
        return self._graph.load("row", ("output", place), np.float64)

    def _first_inputs(self) -> list[float]:
        given = self._episode.parameters
        for name, _ in self._env.interface.start_inputs:
            if name in self._drawn:
                raise UncompilableError(f"it reads the input {name!r}, whose first value is drawn")
        return [float(given.get(name, start)) for name, start in self._env.interface.start_inputs]

    def _add_actions(self, has_older: bool) -> None:
        space: Any = self._env.action_space
        dtype, first = np.dtype(space.dtype), np.ravel(no_action(space))
        self._add("action", dtype, first.tolist(), self._sample.action)
        if has_older:
            last = [self._graph.load("action", i, dtype) for i in range(len(first))]
            self._add("previous_action", dtype, first.tolist(), last)

    def _add_variable(self, name: str) -> None:
        value = np.ravel(self._starts[name]).astype(np.float64)
        self._add(name, value.dtype, value.tolist(), self._sample.updates.get(name, ()))
        if name in self._drawn:
            self._note_parameters(name, value, None)

    def _add_parameter(self, name: str) -> None:
        own = self._episode.parameters[name]
        value, variable = np.ravel(own), self._env.interface.parameter(name, own)
        self._add(name, np.dtype(np.float64), value.tolist(), ())
        self._note_parameters(name, value, variable)

    def _note_parameters(
        self, name: str, values: npt.NDArray[Any], variable: Variable | None
    ) -> None:
        field = self._fields[name]
        for element, value in enumerate(values):
            own = name if len(values) == 1 else f"{name}[{element}]"
            self._parameters.append(Parameter(own, field, element, float(value), variable))

    def _add(self, name: str, dtype: np.dtype[Any], starts: Any, updates: Iterable[int]) -> None:
        self._fields[name] = len(self._kept)
        self._kept.append(Kept(name, dtype, tuple(starts), tuple(int(node) for node in updates)))

    # Where values come from.

    def _load(self, number: int, places: list[int]) -> Load | None:
        """Source of a node's value; None for a computed value or a constant."""
        node = self._graph.nodes[number]
        what: Any = node.what
        if number in self._external:
            return "measurement", len(places) + list(self._external).index(number)
        match node.kind:
            case "active":
                return ("active",)
            case "action" | "previous_action":
                return "kept", self._fields[node.kind], what
            case "row":
                return self._row(_row_of(node), places)
        return None

    def _row(self, row: Any, places: list[int]) -> Load | None:
        match row[0]:
            case "output":
                return "measurement", places.index(row[1])
            case "kept":
                return "kept", self._fields["previous"], places.index(row[1])
            case "input":
                return "kept", self._fields["inputs"], row[1]
            case "step_count":
                return ("count",)
            case "given":
                return _GIVEN, row[1]
            case "before" if row[1] in self._fields:
                return "kept", self._fields[row[1]], row[2]
            case "before":
                return "constant", float(np.ravel(self._starts[row[1]])[row[2]])
            case "parameter" if row[1] in self._drawn:
                return "kept", self._fields[row[1]], 0
            case "parameter":
                return "constant", float(self._episode.parameters[row[1]])
        raise UncompilableError(f"it reads {row[0]!r}, which a controller does not have")
