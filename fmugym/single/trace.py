"""Tracing the hooks of a single environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.single.purity import unchanged_globals
from fmugym.single.watch import Watched, noting_reads, watched_in
from fmugym.task.readings import Readings, reading
from fmugym.task.results import FLOAT32_LIMIT
from fmugym.task.values import EpisodeVariables
from fmugym.vector.actions import is_array_space
from fmugym.vector.contents import Contents, borrowed
from fmugym.vector.hooks.graph import Cell
from fmugym.vector.hooks.lowering import Store, compile_graph
from fmugym.vector.hooks.patches import exclusive, numpy_of
from fmugym.vector.hooks.program import Program, UntraceableError, letter_of
from fmugym.vector.hooks.scalars import Scalar, ScalarGraph, SmallArray, array_of, lifted, scalar_of
from fmugym.vector.hooks.symbolic import SymbolicParameters, symbolic_outputs
from fmugym.vector.hooks.symbols import Symbols
from fmugym.vector.hooks.tables import tables_in
from fmugym.vector.hooks.trace import (
    SeenArray,
    in_hook,
    require_unchanged,
    tables_of,
    to_integer,
)

__all__ = ["Kind", "SingleTask", "kind_of", "trace_single"]

_DTYPES: Final = {
    bool: np.dtype(np.bool_),
    int: np.dtype(np.int64),
    float: np.dtype(np.float64),
}


class Kind(NamedTuple):
    """The kind of an episode variable.

    Attributes:
        dtype: The type of its elements.
        python: ``bool``, ``int`` or ``float`` for a number of Python, otherwise None.
        shape: The shape of an array; None for a number.
    """

    dtype: np.dtype[Any]
    python: type | None
    shape: tuple[int, ...] | None


def kind_of(value: Any) -> Kind | None:
    """The kind of a value; None if programs cannot hold it."""
    if isinstance(value, Scalar):
        return Kind(value.dtype, value.weak, None)
    if isinstance(value, Symbols):
        is_number = isinstance(value, SmallArray) and value.is_number
        return Kind(value.dtype, None, None if is_number else value.shape)
    if type(value) in _DTYPES:
        return Kind(_DTYPES[type(value)], type(value), None)
    if not isinstance(value, np.generic) and type(value) is not np.ndarray:
        return None
    is_number = value.dtype.kind in "biuf" and value.dtype.itemsize <= 8
    shape = value.shape if type(value) is np.ndarray else None
    return Kind(value.dtype, None, shape) if is_number else None


@dataclass(frozen=True)
class SingleTask:
    """The programs of a single environment.

    Attributes:
        inputs: From the action to the inputs.
        judgement: From the outputs to done, truncated and reward; it stores episode variables and
            the observation.
        seen: The arrays of the observation that the second program stores.
        keys: The keys of a dict of observations; None for one array.
        variables: The kinds of the episode variables by name.
        updated: The names of the variables that ``_update`` writes.
        action_type: The class of the actions.
        watched: The attributes that hooks read.
        inherited: The names that hooks read, and that the environment does not have itself.
        left: The hooks that cannot be traced, and why. They run in Python; no other hook needs
            what they return.
    """

    inputs: Program
    judgement: Program
    seen: tuple[SeenArray, ...]
    keys: tuple[str, ...] | None
    variables: Mapping[str, Kind]
    updated: tuple[str, ...]
    action_type: type
    watched: tuple[Watched, ...]
    inherited: frozenset[str]
    left: Mapping[str, str]

    def loads(self, kind: str) -> bool:
        """Whether one of the programs loads values of this kind."""
        return self.inputs.loads(kind) or self.judgement.loads(kind)

    def still_holds(self, attributes: Mapping[str, Any]) -> bool:
        """Whether the attributes are those that the hooks were traced with."""
        if not self.inherited.isdisjoint(attributes):
            return False
        return all(one.is_in(attributes) for one in self.watched)


def trace_single(env: FMUEnv, action: Any) -> SingleTask:
    """Trace the hooks of an environment, with the readings that it has now.

    Args:
        env: The environment, in an episode.
        action: An action, for its type.

    Raises:
        UntraceableError: If ``_update`` or ``_is_done``, on which other hooks depend, do what a
            program cannot do, or if a hook may do more than compute or reads what cannot be
            watched.
    """
    if env._pool_tells:
        raise UntraceableError("the pool tells infos of its own")
    attributes = dict(vars(env))
    with (
        exclusive(),
        unchanged_globals(env),
        borrowed(env),
        tables_in(env),
        reading(env, Readings.of(env)),
        noting_reads(env) as names,
    ):
        parts = _Tracer(env, action, names).parts()
    watched = watched_in(attributes, names)
    inherited = frozenset(name for name in names if name not in attributes)
    return SingleTask(**parts, watched=watched, inherited=inherited)


class _Tracer:
    """Calls the hooks of one environment with symbols.

    Args:
        env: The environment, in an episode.
        action: An action, for its type.
        read: The names of the attributes that were read up to now; those that only hooks read
            that cannot be traced are taken out.
    """

    def __init__(self, env: FMUEnv, action: Any, read: set[str]) -> None:
        self._env, self._action, self._read = env, action, read
        self._left: dict[str, str] = {}
        self._parameters = dict(env.parameters)
        self._graph = ScalarGraph()
        self._tables = dict(tables_of(env))
        self._variables: dict[str, Kind] = {}
        for name, value in env.variables.items():
            kind = kind_of(value)
            if kind is None:
                raise UntraceableError(f"the episode variable {name!r} is no number and no array")
            self._variables[name] = kind

    def parts(self) -> dict[str, Any]:
        """Trace all hooks, again if ``_update`` gives variables other types, or one is left out."""
        for _ in range(7):
            before = dict(self._variables), dict(self._left)
            parts = self._traced()
            if (self._variables, self._left) == before:
                return parts
        raise UntraceableError("_update gives a variable another type in each step")

    def _traced(self) -> dict[str, Any]:
        inputs = self._trace_inputs()
        self._begin(judging=True)
        stores, updated = self._trace_update()
        done = self._call("_is_done", self._flag)
        self._env.done = Scalar(_single(self._graph, done, np.bool_), bool)
        truncated = self._constant(False, np.bool_)
        if self._env._own.is_truncated:
            truncated = self._or_left("_is_truncated", self._flag, truncated)
        no_reward = self._constant(0.0, np.float64)
        reward = self._or_left("_reward_policy", self._number, no_reward)
        seen, keys, more = self._trace_seen()
        results = [cell.node for cell in (done, truncated, self._guarded(reward))]
        return {
            "inputs": inputs,
            "judgement": compile_graph(self._graph, stores + more, results, len(seen)),
            "seen": tuple(seen),
            "keys": keys,
            "variables": dict(self._variables),
            "updated": updated,
            "action_type": type(self._action),
            "left": dict(self._left),
        }

    def _begin(self, judging: bool) -> None:
        self._graph = ScalarGraph()
        for name, table in self._tables.items():
            vars(self._env)[name] = lifted(self._graph, table)
        self._readings(judging).place_in(self._env)
        self._contents = Contents(self._env)

    def _call(self, name: str, of: Callable[[Any], Any]) -> Any:
        """Call a hook, and make cells of what it returns."""
        with in_hook(self._env, name), numpy_of(self._graph), np.errstate(all="ignore"):
            value = getattr(self._env, name)()
            require_unchanged(self._contents)
            return of(value)

    def _or_left(self, name: str, of: Callable[[Any], Any], nothing: Any) -> Any:
        """Trace a hook. If that fails, leave it to Python; something else takes its place.

        What it has read need not be watched, but the hook itself must not be replaced.
        """
        if name in self._left:
            return nothing
        before = set(self._read)
        try:
            return self._call(name, of)
        except UntraceableError as reason:
            self._left[name] = str(reason)
            self._read.intersection_update(before | {name})
            return nothing

    def _constant(self, value: Any, dtype: npt.DTypeLike) -> Cell:
        return self._graph.constant(value, np.dtype(dtype))

    def _guarded(self, value: Cell) -> Cell:
        """NaN where Python would raise an exception: the step is then repeated in Python."""
        bad = self._graph.any_guard()
        if bad is None:
            return value
        return self._graph.choose(bad, self._constant(np.nan, np.float64), value)

    # Inputs.

    def _trace_inputs(self) -> Program:
        self._begin(judging=False)
        found = self._or_left("_get_inputs", self._input_cells, [])
        cells = [self._guarded(cell) for cell in found]
        stores = [Store(cell.node, ("wanted", index)) for index, cell in enumerate(cells)]
        return compile_graph(self._graph, stores, [], 0)

    def _input_cells(self, value: Any) -> list[Cell]:
        variables = self._env._interface.inputs
        cells = lifted(self._graph, value).cells.reshape(-1)
        if len(cells) != len(variables):
            raise UntraceableError("the number of inputs is not that of the config")
        return [self._typed(v, cell) for v, cell in zip(variables, cells, strict=True)]

    def _typed(self, variable: Any, cell: Cell) -> Cell:
        """Round a value to its input's type; outside of the type's range it becomes NaN."""
        cell = self._graph.cast(cell, np.dtype(np.float64))
        if variable.type in {"Real", "Float64"}:
            return cell
        value: Any = Scalar(_single(self._graph, cell, np.float64))
        if variable.kind == "boolean":
            typed: Any = np.where(value >= 0.5, 1.0, 0.0)
            typed = np.where(np.isfinite(value), typed, value)
        elif variable.kind in {"integer", "enumeration"}:
            typed = to_integer(variable, value)
        else:
            raise UntraceableError(f"the input {variable.name!r} is a {variable.type}")
        return _only(lifted(self._graph, typed))

    # What follows the FMU's step.

    def _trace_update(self) -> tuple[list[Store], tuple[str, ...]]:
        if not self._env._own.update:
            return [], ()
        before = dict(self._env.variables)
        self._call("_update", lambda value: None)
        stores, updated = [], []
        for name, old in before.items():
            new = self._env.variables[name]
            if new is old:
                continue
            kind = kind_of(new)
            if kind is None:
                raise UntraceableError(f"_update makes {name!r} what is no number and no array")
            if (kind.shape or ()) != (self._variables[name].shape or ()):
                raise UntraceableError(f"_update changes the shape of {name!r}")
            self._variables[name] = kind
            updated.append(name)
            for i, cell in enumerate(lifted(self._graph, new).cells.reshape(-1)):
                stores.append(Store(cell.node, ("variable", name, i)))
        return stores, tuple(updated)

    def _flag(self, value: Any) -> Cell:
        symbols = lifted(self._graph, value)
        if symbols.dtype != np.bool_:
            raise UntraceableError("a flag is no Boolean")
        return _only(symbols)

    def _number(self, value: Any) -> Cell:
        return self._graph.cast(_only(lifted(self._graph, value)), np.dtype(np.float64))

    def _trace_seen(self) -> tuple[list[SeenArray], tuple[str, ...] | None, list[Store]]:
        """Trace the observation, unless the pool makes it."""
        if self._env._pool_observes:
            return [], None, []
        found: tuple[list[SeenArray], tuple[str, ...] | None, list[Store]]
        found = self._or_left("_get_observation", self._see, ([], None, []))
        return found

    def _see(self, value: Any) -> tuple[list[SeenArray], tuple[str, ...] | None, list[Store]]:
        space: Any = self._env.observation_space
        if not isinstance(space, spaces.Dict):
            array, stores = self._see_one(("observation",), value, space, 0)
            return [array], None, stores
        if type(value) is not dict or value.keys() != space.spaces.keys():
            raise UntraceableError("the observation has other keys than its space")
        seen: list[SeenArray] = []
        stores = []
        for name, part in value.items():
            array, more = self._see_one(("observation", name), part, space[name], len(seen))
            seen.append(array)
            stores += more
        return seen, tuple(value), stores

    def _see_one(
        self, path: tuple[str, ...], value: Any, space: Any, number: int
    ) -> tuple[SeenArray, list[Store]]:
        if not isinstance(value, np.ndarray) or not is_array_space(space):
            raise UntraceableError("the observation is no array, or no dict of arrays")
        symbols = lifted(self._graph, value)
        if symbols.shape != space.shape or not symbols.shape:
            raise UntraceableError("the observation has another shape than its space")
        letter_of(symbols.dtype)
        cells: Any = symbols.cells.reshape(-1)
        if symbols.dtype == np.float64 and space.dtype == np.float32:
            self._guard_large(cells)
        stores = [Store(c.node, None, (number, i, cells.size)) for i, c in enumerate(cells)]
        return SeenArray(path, symbols.shape, symbols.dtype), stores

    def _guard_large(self, cells: Any) -> None:
        """Leave numbers to Python that no float32 can hold: they are a fault."""
        limit = self._constant(FLOAT32_LIMIT, np.float64)
        for cell in cells:
            size = self._graph.apply(np.absolute, (cell,), np.dtype(np.float64))
            self._graph.guard(self._graph.apply(np.greater, (size, limit), np.dtype(np.bool_)))

    # What hooks read.

    def _readings(self, judging: bool) -> Readings:
        env, graph = self._env, self._graph

        def numbers(count: int, kind: str) -> tuple[Scalar, ...]:
            rows = range(count)
            return tuple(scalar_of(graph, "row", (kind, i), np.float64, float) for i in rows)

        values = numbers(len(env.out), "output")
        state = values[: env._output_count]
        return Readings(
            values=values,
            out=symbolic_outputs(env, values),
            state=state,
            previous_state=numbers(env._output_count, "kept") if judging else state,
            inputs=numbers(len(env._interface.inputs), "input"),
            action=self._symbolic_action("action"),
            previous_action=self._symbolic_action("previous_action"),
            step_count=scalar_of(graph, "row", ("step_count",), np.int64, int),
            done=False,
            after_end=False,
            parameters=MappingProxyType(self._symbolic_parameters()),
            variables=self._symbolic_variables("before" if judging else "variable"),
        )

    def _symbolic_action(self, kind: str) -> Any:
        action, graph = self._action, self._graph
        if isinstance(self._env.action_space, spaces.Discrete):
            python = int if type(action) is int else None
            return scalar_of(graph, kind, 0, np.int64, python)
        names = np.empty(action.shape, object)
        for index, place in enumerate(np.ndindex(names.shape)):
            names[place] = index
        return array_of(graph, kind, names, action.dtype)

    def _symbolic_parameters(self) -> dict[str, Any]:
        symbols = {
            name: scalar_of(self._graph, "row", ("parameter", name, i), np.float64, float)
            if type(value) is float
            else value
            for i, (name, value) in enumerate(self._parameters.items())
        }
        return SymbolicParameters(symbols, self._env.fmu.description.strings)

    def _symbolic_variables(self, head: str) -> EpisodeVariables:
        variables = EpisodeVariables(self._variables)
        for name, kind in self._variables.items():
            if kind.shape is None:
                row = (head, name, 0)
                variables[name] = scalar_of(self._graph, "row", row, kind.dtype, kind.python)
                continue
            names = np.empty(kind.shape, object)
            for index, place in enumerate(np.ndindex(kind.shape)):
                names[place] = (head, name, index)
            variables[name] = array_of(self._graph, "row", names, kind.dtype)
        return variables


def _single(graph: ScalarGraph, cell: Cell, dtype: npt.DTypeLike) -> Symbols:
    cells = np.empty((), object)
    cells[()] = cell
    return Symbols(graph, cells, dtype)


def _only(symbols: Symbols) -> Cell:
    if symbols.size != 1:
        raise UntraceableError(f"a result has the shape {symbols.shape}")
    cell: Cell = symbols.cells.reshape(-1)[0]
    return cell
