"""Programs of a task: before the step of the FMU and after it, compiled from its formulas."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain
from operator import or_
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.environment.env import FMUEnv
from fmugym.environment.hooks import ORDER, is_overridden
from fmugym.expressions.compiler import Store, compile_graph
from fmugym.expressions.graph import Computed, Formulas, Graph, Update, Value, where
from fmugym.expressions.program import TYPES, Program, UncompilableError, letter_of
from fmugym.expressions.quantities import QUANTITIES
from fmugym.fmi.variable import Variable

__all__ = [
    "SeenArray",
    "TaskPrograms",
    "Translation",
    "compile_formulas",
    "formulas_of",
    "to_input_type",
    "written_variables",
]

_FLAG, _COUNT = np.dtype(np.bool_), np.dtype(np.int64)


@dataclass(frozen=True)
class SeenArray:
    """An array of observations or infos that a program stores.

    Attributes:
        path: The keys that lead to it: ``"observation"`` or ``"info"``, then names.
        shape: The shape of one environment's part.
        dtype: Its type.
    """

    path: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]


@dataclass(frozen=True)
class TaskPrograms:
    """The programs of a task.

    Attributes:
        inputs: From the action to the inputs; it counts the step.
        conclusion: From the outputs to the episode variables, the results of the step, and which
            episodes have ended; and to the observation, if it is not the default one, and the info.
        observation: To these two alone, at the start of an episode.
        seen: The arrays of observations and infos that programs store.
        variables: The types of the episode variables by name.
        updated: The names of the variables that ``_update`` writes.
    """

    inputs: Program
    conclusion: Program
    observation: Program
    seen: tuple[SeenArray, ...]
    variables: Mapping[str, np.dtype[Any]]
    updated: tuple[str, ...]

    @classmethod
    def without_programs(cls, variables: Iterable[str], inputs: int, limit: int) -> TaskPrograms:
        """A task whose hooks run on arrays; programs pass on inputs, and that an FMU stops.

        Args:
            variables: The names of the episode variables, which are float64 at first.
            inputs: The number of inputs.
            limit: The steps after which an episode is truncated.
        """
        graph, real = Graph(), np.dtype(np.float64)
        stopped = Value(graph, graph.load("stopped", None, _FLAG))
        conclusion = compile_graph(graph, _result_stores(stopped, None, None, limit))
        graph = Graph()
        given = [graph.load("row", ("given", i), real) for i in range(inputs)]
        stores = [Store(node, ("input", i)) for i, node in enumerate(given)]
        return cls(
            compile_graph(graph, [*stores, _count_store(graph)]),
            conclusion,
            compile_graph(Graph(), []),
            (),
            dict.fromkeys(variables, real),
            (),
        )

    def with_tables(self, tables: Mapping[bytes, npt.NDArray[Any]]) -> TaskPrograms:
        """The same task with other tables, by the bytes of those whose place they take."""
        programs = (self.inputs, self.conclusion, self.observation)
        inputs, conclusion, observation = (one.with_tables(tables) for one in programs)
        return replace(self, inputs=inputs, conclusion=conclusion, observation=observation)


def _count_store(graph: Graph) -> Store:
    """The count of steps with this one, to be stored."""
    return Store((_row(graph, "step_count", _COUNT) + 1).cast(_COUNT).node, ("step_count", 0))


def _result_stores(
    terminated: Value, truncated: Value | None, reward: Value | None, limit: int
) -> list[Store]:
    """The results of a step, and which episodes have ended, to be stored.

    Args:
        terminated: Where tasks have ended.
        truncated: Where they are cut; None if by the limit only.
        reward: The rewards; None if there are none.
        limit: The steps after which an episode is truncated, too.
    """
    graph = terminated.graph
    cuts = [] if truncated is None else [truncated]
    if limit < sys.maxsize:
        cuts.append(_row(graph, "step_count", _COUNT) >= limit)
    results = {
        "reward": Value.of(graph, 0.0) if reward is None else reward.number,
        "terminated": terminated,
        "truncated": reduce(or_, cuts) if cuts else Value.of(graph, False),
        "done": terminated,
        "ended": reduce(or_, cuts, terminated),
    }
    return [Store(value.node, (kind, 0)) for kind, value in results.items()]


def _seen_stores(number: int, values: Sequence[Value]) -> list[Store]:
    """The elements of an array of observations or infos, to be stored, by its number."""
    letter, count = letter_of(values[0].dtype), len(values)
    return [
        Store(value.node, ("seen", number, place, count, TYPES.index(letter)))
        for place, value in enumerate(values)
    ]


def _row(graph: Graph, kind: str, dtype: np.dtype[Any]) -> Value:
    return Value(graph, graph.load("row", (kind, 0), dtype))


def to_input_type(variable: Variable, value: Value) -> Value:
    """Round a value to its input's type, as ``to_input_types`` does.

    A value that is outside of the type's range becomes NaN, which no pool steps with.
    """
    if variable.type in {"Real", "Float64"}:
        return value
    if variable.kind == "boolean":
        return where(_is_finite(value), where(value >= 0.5, 1.0, 0.0), value)
    if variable.kind in {"integer", "enumeration"}:
        return _to_integer(variable, value)
    limit = float(np.finfo(np.float32).max)
    size: Value = np.absolute(value)
    return where(size <= limit, value, np.nan)


def _to_integer(variable: Variable, value: Value) -> Value:
    """The nearest integer, or the nearest item of an Enumeration; NaN outside of the range."""
    low, high = variable.integer_limits
    largest = 2.0**53
    rounded: Any = np.rint(value) + 0.0  # has no negative zero
    items = [item for _, item in variable.items]
    if items:
        low, high = min(items), max(items)
        rounded = _nearest(items, rounded)
    within = (rounded >= float(max(low, -largest))) & (rounded <= float(min(high, largest)))
    return where(within, rounded, where(_is_finite(value), np.nan, value))


def _is_finite(value: Value) -> Value:
    return (value - value) <= 0.0


def _nearest(items: list[int], value: Value) -> Value:
    """The nearest of some items, the first of those that are as near; others stay."""
    if set(items) == set(range(min(items), max(items) + 1)):
        return value
    nearest = value.beside(float(items[0]))
    for item in items[1:]:
        here, there = (np.absolute(value - one) for one in (float(item), nearest))
        is_nearer: Any = here < there
        nearest = where(is_nearer, float(item), nearest)
    inside = (value >= float(min(items))) & (value <= float(max(items)))
    return where(inside, nearest, value)


_DOUBLE: Final = np.dtype(np.float64)
_FLAG_TYPE: Final = np.dtype(np.bool_)

_STATUSES: Final = ("failed", "stopped")
"""Flags that the pool makes of the statuses of FMUs."""

_Seen = tuple[SeenArray, list[Value]]
"""An array that a program stores, and its elements."""


def formulas_of(env: FMUEnv) -> Formulas | None:
    """The formulas that all hooks of a step are; None if the class overrides one of them."""
    hooks = (*ORDER, "_goal_reward")
    is_own = any(is_overridden(env, hook) for hook in hooks)
    return None if is_own else env.formulas


def compile_formulas(env: FMUEnv, formulas: Formulas, limit: int) -> TaskPrograms:
    """Make the programs of a task.

    Args:
        env: An environment of the task.
        formulas: What the task computes.
        limit: The steps after which an episode is truncated.

    Raises:
        UncompilableError: If programs do not have its actions or observations, or it is too long.
    """
    if env._instance.tells:
        raise UncompilableError("the pool tells infos of its own")
    letter_of(np.dtype(env.action_space.dtype))
    conclusion, updated = _conclusion(env, formulas, limit)
    observation, seen = _observation(env, formulas)
    types = dict.fromkeys(env.variables, _DOUBLE)
    return TaskPrograms(_inputs(env, formulas), conclusion, observation, seen, types, updated)


def _inputs(env: FMUEnv, formulas: Formulas) -> Program:
    """The program from the action to the inputs."""
    graph = Graph()
    inputs = Translation(env, graph, has_stepped=False).inputs(formulas)
    stores = [Store(value.node, ("input", i)) for i, value in enumerate(inputs)]
    return compile_graph(graph, [*stores, _count_store(graph)])


def _conclusion(env: FMUEnv, formulas: Formulas, limit: int) -> tuple[Program, tuple[str, ...]]:
    """The program that follows the FMU's step, and the variables that it writes."""
    graph = Graph()
    fresh = Value(graph, graph.load("row", ("ended", 0), _FLAG_TYPE))
    failed, stopped = (Value(graph, graph.load(kind, None, _FLAG_TYPE)) for kind in _STATUSES)
    has_stepped: Value = np.logical_not(failed | fresh)
    known = written_variables(env, graph, formulas.updates, has_stepped)
    stores = [
        Store(value.node, ("variable", name, *(places or [0])))
        for (_, name, *places), value in known.items()
    ]
    updated = tuple(dict.fromkeys(name for _, name, *_ in known))
    done = stopped
    if formulas.terminated is not None:
        done = Translation(env, graph, True, dict(known)).of(formulas.terminated) | stopped
    values = Translation(env, graph, True, known | {("done",): done})
    truncated, reward = (
        None if one is None else values.of(one) for one in (formulas.truncated, formulas.reward)
    )
    shown = Translation(env, graph, True, known | {("done",): done & has_stepped})
    for number, (_, elements) in enumerate(_seen(env, formulas, shown)):
        stores += _seen_stores(number, elements)
    stores += _result_stores(done, truncated, reward, limit)
    return compile_graph(graph, stores), updated


def _observation(env: FMUEnv, formulas: Formulas) -> tuple[Program, tuple[SeenArray, ...]]:
    """The program of observations and infos at the start of an episode, and their arrays."""
    graph = Graph()
    values = Translation(env, graph, True, {("done",): Value.of(graph, False)})
    seen = _seen(env, formulas, values)
    stores = [_seen_stores(number, elements) for number, (_, elements) in enumerate(seen)]
    return compile_graph(graph, [*chain(*stores)]), tuple(array for array, _ in seen)


def _seen(env: FMUEnv, formulas: Formulas, values: Translation) -> list[_Seen]:
    """The info if there is one, and the observation unless the pool makes it."""
    conversions = env._conversions
    parts = [*_named(("info",), formulas.info, values)] if conversions.has_info else []
    if conversions.pool_observes and not parts:
        return []
    elements = values.observation(formulas)
    dtype = np.dtype(env.observation_space.dtype)
    return [(SeenArray(("observation",), (len(elements),), dtype), elements), *parts]


def _named(path: tuple[str, ...], part: Computed, values: Translation) -> Iterator[_Seen]:
    """The values of an info, each with the names that lead to it."""
    if isinstance(part, Mapping):
        for name, one in part.items():
            yield from _named((*path, name), one, values)
        return
    assert isinstance(part, Value)
    value = values.of(part)
    yield SeenArray(path, (), value.dtype), [value]


class Translation:
    """From the graph of a task to that of a program.

    Args:
        env: An environment of the task.
        graph: That of the program.
        has_stepped: Whether the FMU has stepped.
        known: Quantities that are no rows any more, by name and keys: the variables that are
            written, and ``done``; actions by their element.
    """

    def __init__(
        self,
        env: FMUEnv,
        graph: Graph,
        has_stepped: bool,
        known: Mapping[Any, Value] | None = None,
    ) -> None:
        self._env, self._graph, self._has_stepped = env, graph, has_stepped
        self._known = {} if known is None else known
        self._nodes: dict[int, int] = {}

    def of(self, value: Value) -> Value:
        """The same value in the graph of the program."""
        source = value.graph
        for number in source.needed([value.node], self._nodes):
            if number not in self._nodes:
                kind, what, operands, dtype = source.nodes[number]
                if kind == "row":
                    self._nodes[number] = self._read(what).cast(dtype).node
                    continue
                if kind in ("take", "interpolate"):
                    self._graph.tables[what] = source.tables[what]
                own = tuple(self._nodes[one] for one in operands)
                self._nodes[number] = self._graph.add(kind, what, own, dtype)
        return Value(self._graph, self._nodes[value.node])

    def inputs(self, formulas: Formulas) -> list[Value]:
        """The FMU's inputs, each rounded to its type."""
        given = formulas.inputs
        inputs = self._elements_of_action() if given is None else map(self.of, given)
        variables = self._env.interface.inputs
        return [to_input_type(v, value.number) for v, value in zip(variables, inputs, strict=True)]

    def observation(self, formulas: Formulas) -> list[Value]:
        """The elements of the observation, in the type of their space.

        Raises:
            UncompilableError: If the space is no array of numbers.
        """
        space: Any = self._env.observation_space
        if not isinstance(space, spaces.Box | spaces.MultiBinary):
            raise UncompilableError(f"programs make no observations of {space}")
        if formulas.observation is None:
            count = self._env.interface.output_count
            elements = [self.quantity("outputs", place) for place in range(count)]
        else:
            elements = [self.of(one) for one in formulas.observation]
        return [one.cast(space.dtype) for one in elements]

    def _elements_of_action(self) -> list[Value]:
        """The numbers that the default of ``_get_inputs`` gives."""
        space, values = self._env.action_space, self._env._conversions.action_values
        count = int(np.prod(space.shape or (), dtype=int))
        elements = [self._loaded("action", index) for index in range(count)]
        if isinstance(values, range):
            return [one + values[0] for one in elements]
        if values is None:
            return elements
        self._graph.tables["values of the action"] = np.array(values)
        return [one.taken("values of the action") for one in elements]

    def quantity(self, name: str, *keys: str | int) -> Value:
        """A quantity of the episode as it is now."""
        return self._read((name, *keys))

    def _row(self, *what: Any, dtype: np.dtype[Any] = _DOUBLE) -> Value:
        return Value(self._graph, self._graph.load("row", what, dtype))

    def _loaded(self, attribute: str, index: int) -> Value:
        known = self._known.get((attribute, index))
        if known is not None:
            return known
        dtype = np.dtype(self._env.action_space.dtype)
        return Value(self._graph, self._graph.load(attribute, index, dtype))

    def _read(self, what: Any) -> Value:
        """Quantity of an environment, see ``Value.read``."""
        if what in self._known:
            return self._known[what]
        name, *keys = what
        if name in ("action", "previous_action"):
            return self._loaded(name, keys[0] if keys else 0)
        if name == "time":
            return self._time()
        if name == "after_end":
            return Value.of(self._graph, False)
        quantity = QUANTITIES[name]
        kind = quantity.after if self._has_stepped else quantity.before
        if kind is None:
            raise UncompilableError(f"it reads {name!r} before there is one")
        place = keys.pop() if keys and isinstance(keys[-1], int) else 0
        return self._row(kind, *keys, place, dtype=quantity.dtype)

    def _time(self) -> Value:
        """The time of the FMU, as ``FMUEnv.time`` computes it."""
        env, spec = self._env, self._env.pool_spec
        start: Value | float = spec.start_time
        if env.config.draws_start_time:
            start = self._row("parameter", "start_time", 0)
        count: Value = (self.quantity("step_count") + env.warm_up_steps) * spec.substeps
        return count * spec.time_step / spec.substeps + start


def written_variables(
    env: FMUEnv, graph: Graph, updates: Sequence[Update], has_stepped: Value
) -> dict[tuple[Any, ...], Value]:
    """Values that updates write to episode variables; the others keep theirs without a step.

    Args:
        env: An environment of the task.
        graph: That of the program.
        updates: See ``Formulas``.
        has_stepped: Where there was a step without a failure.

    Returns:
        The values by ``("variables", name)``, and the place of an element if there are several.
    """
    written: dict[tuple[Any, ...], Value] = {}
    for update in updates:
        values = Translation(env, graph, True, dict(written))
        for name, value in update.items():
            if isinstance(value, Value):
                written["variables", name] = values.of(value).number
                continue
            for place, one in enumerate(value):
                written["variables", name, place] = values.of(one).number
    before = Translation(env, graph, True)
    return {key: where(has_stepped, value, before.quantity(*key)) for key, value in written.items()}
