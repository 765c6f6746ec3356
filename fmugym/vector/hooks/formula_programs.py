"""From the formulas of a task to its programs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.expressions.formulas import Formulas, Update
from fmugym.expressions.graph import Graph
from fmugym.expressions.lowering import Store, compile_graph
from fmugym.expressions.program import Program, UncompilableError, letter_of
from fmugym.expressions.quantities import QUANTITIES
from fmugym.expressions.value import Computed, Value, where
from fmugym.task.own_hooks import is_overridden
from fmugym.task.step import ORDER
from fmugym.vector.hooks.task_programs import (
    SeenArray,
    TaskPrograms,
    counted,
    ended,
    seen_stores,
    to_input_type,
)

__all__ = ["Translation", "compile_formulas", "formulas_of", "written_variables"]

_DOUBLE: Final = np.dtype(np.float64)
_FLAG: Final = np.dtype(np.bool_)

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
    return compile_graph(graph, [*stores, counted(graph)])


def _conclusion(env: FMUEnv, formulas: Formulas, limit: int) -> tuple[Program, tuple[str, ...]]:
    """The program that follows the FMU's step, and the variables that it writes."""
    graph = Graph()
    fresh = Value(graph, graph.load("row", ("ended", 0), _FLAG))
    failed, stopped = (Value(graph, graph.load(kind, None, _FLAG)) for kind in _STATUSES)
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
        values.of(one) if one is not None else Value.of(graph, default)
        for one, default in ((formulas.truncated, False), (formulas.reward, 0.0))
    )
    shown = Translation(env, graph, True, known | {("done",): done & has_stepped})
    for number, (_, elements) in enumerate(_seen(env, formulas, shown)):
        stores += seen_stores(number, elements)
    stores += ended(done, truncated, reward, limit)
    return compile_graph(graph, stores), updated


def _observation(env: FMUEnv, formulas: Formulas) -> tuple[Program, tuple[SeenArray, ...]]:
    """The program of observations and infos at the start of an episode, and their arrays."""
    graph = Graph()
    values = Translation(env, graph, True, {("done",): Value.of(graph, False)})
    seen = _seen(env, formulas, values)
    stores = [seen_stores(number, elements) for number, (_, elements) in enumerate(seen)]
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
