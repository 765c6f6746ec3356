"""Tracing: the hooks of a task become programs for the native pool.

A hook is called with symbolic arrays instead of numbers; see ``symbols``. They record what the
hook computes. A hook that does anything that cannot be recorded, such as a branch, cannot be
traced, and is called on arrays.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.env import FMUEnv
from fmugym.expressions.graph import Cell, Graph
from fmugym.expressions.lowering import Store, compile_graph
from fmugym.expressions.program import Program, UntraceableError
from fmugym.expressions.value import Value
from fmugym.task.readings import READINGS
from fmugym.vector.contents import Contents
from fmugym.vector.hooks.hook_results import type_of_variable
from fmugym.vector.hooks.patches import numpy_of
from fmugym.vector.hooks.symbolic import symbolic_readings
from fmugym.vector.hooks.symbols import (
    LANES,
    Symbols,
    as_symbols,
    each,
    loaded,
    loaded_rows,
    same_cells,
    same_for_all,
    spread,
)
from fmugym.vector.hooks.tables import Table, is_table
from fmugym.vector.hooks.task_programs import SeenArray, to_input_type

__all__ = ["Tracer"]


_Made = TypeVar("_Made")

_Seen = tuple[tuple[str, ...], npt.NDArray[Any], np.dtype[Any]]
"""The path and the type of a ``SeenArray``, and the nodes of the values in it."""


class Tracer:
    """Calls the hooks of one environment with symbols.

    Args:
        env: The prototype.
        attributes: Those that have one number for each environment.
        refused: Hooks that are not to be traced, and why.
    """

    _contents: Contents

    def __init__(
        self,
        env: FMUEnv,
        attributes: Mapping[str, npt.NDArray[Any]],
        refused: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._env, self._attributes, self._refused = env, attributes, refused
        self._graph = Graph()
        self._left: dict[str, str] = {}
        self._tables = dict(tables_of(env))
        self._variables: dict[str, np.dtype[Any]] = {
            name: np.dtype(np.float64) for name in env.variables
        }

    def settle(self, trace: Callable[[], _Made]) -> _Made:
        """Call what traces hooks, again if ``_update`` gives variables other types.

        From the second step on, hooks on arrays read a variable in the type that was assigned.
        """
        for _ in range(3):
            before = dict(self._variables)
            made = trace()
            if self._variables == before:
                return made
        raise UntraceableError("_update gives a variable another type in each step")

    def _begin(self, judging: bool) -> None:
        self._graph = Graph()
        for name, table in self._tables.items():
            vars(self._env)[name] = table.view(Table)
        for name, row in self._attributes.items():
            symbols = loaded_rows(self._graph, (), "attribute", name, dtype=row.dtype)
            vars(self._env)[name] = symbols
        self._env.inside.readings = symbolic_readings(
            self._env, self._graph, self._variables, judging
        )
        self._contents = Contents(self._env, outside=True)

    def _call(self, name: str, of: Callable[[Any], Any]) -> Any:
        """Call a hook, and make nodes of what it returns."""
        if name in self._refused:
            raise UntraceableError(self._refused[name])
        with in_hook(self._env, name):
            with numpy_of(self._graph), np.errstate(all="ignore"):
                value = getattr(self._env, name)()
            require_unchanged(self._contents)
            return of(value)

    def _nodes(self, value: Any, shape: tuple[int, ...] | None, dtype: Any) -> npt.NDArray[Any]:
        """The nodes of a result, the environments last; one value stands for all environments."""
        symbols = as_symbols(self._graph, value)
        if symbols.shape[-1:] != (LANES,) and symbols.size == 1 and shape == ():
            symbols = symbols.like(np.repeat(symbols.cells.reshape(1), LANES))
        elif shape == () and symbols.ndim > 1 and symbols.size == LANES:
            symbols = symbols.like(symbols.cells.reshape(LANES))
        if shape is not None and symbols.shape != (*shape, LANES):
            raise UntraceableError(f"a result has the shape {symbols.shape}, environments last")
        return same_for_all(symbols if dtype is None else symbols.cast(dtype))

    def _row(self, value: Any, dtype: npt.DTypeLike) -> Symbols:
        """A result that is one value for each environment."""
        return spread(self._graph, self._nodes(value, (), dtype), dtype)

    def _told(self, kind: str) -> Any:
        """A flag that the pool sets: whether the FMU has ``stopped``, or is ``active``."""
        return loaded(self._graph, kind, (), lambda _: None, np.bool_)

    # Inputs.

    def _trace_inputs(self) -> Program:
        self._begin(judging=False)
        try:
            nodes = self._call("_get_inputs", self._input_nodes)
            stores = [Store(int(node), ("input", index)) for index, node in enumerate(nodes)]
            return compile_graph(self._graph, stores, [], 0)
        except UntraceableError as reason:
            self._left["_get_inputs"] = str(reason)
            return compile_graph(Graph(), [], [], 0)

    def _input_nodes(self, value: Any) -> list[int]:
        variables = self._env.inside.interface.inputs
        is_list = isinstance(value, list | tuple)
        if not is_list:
            array = as_symbols(self._graph, value)
            value = array if array.ndim >= (2 if len(variables) == 1 else 1) else [array]
        if len(value) != len(variables):
            raise UntraceableError("the number of inputs is not that of the config")
        rows = [self._row(row, np.float64) for row in value]
        typed = [
            row.like(each(lambda cell, v=v: self._typed(v, cell), row.cells))
            for v, row in zip(variables, rows, strict=True)
        ]
        return [int(same_for_all(row)) for row in typed]

    def _typed(self, variable: Any, cell: Cell) -> Cell:
        return to_input_type(variable, Value(self._graph, cell)).cell

    # What follows the FMU's step.

    def _trace_update(self) -> tuple[list[Store], tuple[str, ...]]:
        """Trace ``_update``; environments that have not stepped keep their variables."""
        if not self._env.inside.own.update:
            return [], ()
        before = dict(self._env.variables)
        old = {name: symbols.copy() for name, symbols in before.items()}
        for symbols in before.values():
            symbols.writeable = True
        self._call("_update", lambda value: None)
        stores, updated = [], []
        for name, symbols in before.items():
            new, symbols.writeable = self._env.variables[name], False
            if new is symbols and same_cells(new, old[name]):
                continue
            kept = self._kept_where_idle(name, new, old[name])
            self._env.variables[name] = kept
            updated.append(name)
            nodes = same_for_all(kept).reshape(-1)
            stores += [Store(int(n), ("variable", name, i)) for i, n in enumerate(nodes)]
        return stores, tuple(updated)

    def _kept_where_idle(self, name: str, new: Any, old: Symbols) -> Symbols:
        symbols = as_symbols(self._graph, new)
        if symbols.shape != old.shape:
            if symbols.size != 1:
                raise UntraceableError(f"_update changes the shape of {name!r}")
            symbols = symbols.like(np.broadcast_to(symbols.cells.reshape(()), old.shape))
        self._variables[name] = type_of_variable(self._env.inside.draws, name, symbols.dtype)
        kept: Any = np.where(self._told("active"), symbols.cast(old.dtype), old)
        kept.writeable = False
        return cast(Symbols, kept)

    def _or_left(self, name: str, of: Callable[[Any], Any], constant: Any) -> Any:
        """Trace a hook. If that fails, leave it to numpy; a constant takes its place."""
        try:
            return self._call(name, of)
        except UntraceableError as reason:
            self._left[name] = str(reason)
            return self._row(constant, constant.dtype)

    def _flags(self, value: Any) -> Symbols:
        symbols = as_symbols(self._graph, value)
        if symbols.dtype != np.bool_:
            constants = [self._graph.value(cell) for cell in symbols.cells.reshape(-1)]
            if any(constant not in (0, 1) or constant is None for constant in constants):
                raise UntraceableError("a flag is no Boolean")
        return self._row(symbols, np.bool_)

    def _rewards(self, value: Any) -> Symbols:
        return self._row(value, np.float64)

    def _trace_seen(self) -> tuple[list[SeenArray], list[Store]]:
        """Trace the info if there is one, and the observation unless the pool makes it."""
        inside = self._env.inside
        parts = self._seen("_get_info", self._see_info) if inside.has_info else []
        if not inside.pool_observes or parts:
            parts = self._seen("_get_observation", self._see_observation) + parts
        return [SeenArray(path, nodes.shape, dtype) for path, nodes, dtype in parts], _stores(parts)

    def _seen(self, name: str, see: Callable[[Any], Iterator[_Seen]]) -> list[_Seen]:
        """What a hook fills arrays with; nothing if it is left to numpy."""
        try:
            parts: list[_Seen] = self._call(name, lambda value: list(see(value)))
            compile_graph(self._graph, _stores(parts), [], len(parts))
        except UntraceableError as reason:
            self._left[name] = str(reason)
            return []
        return parts

    def _see_observation(self, value: Any) -> Iterator[_Seen]:
        return self._see(("observation",), value, self._env.observation_space)

    def _see(self, path: tuple[str, ...], value: Any, space: Any) -> Iterator[_Seen]:
        if isinstance(space, spaces.Dict):
            if not isinstance(value, Mapping) or value.keys() != space.spaces.keys():
                raise UntraceableError("the observation has other keys than its space")
            for name in space.spaces:
                yield from self._see((*path, name), value[name], space[name])
            return
        shape, symbols = space.shape or (), as_symbols(self._graph, value)
        if symbols.shape != (*shape, LANES):
            raise UntraceableError(f"the observation has the shape {symbols.shape}")
        yield path, self._nodes(symbols, shape, space.dtype), np.dtype(space.dtype)

    def _see_info(self, value: Any, path: tuple[str, ...] = ("info",)) -> Iterator[_Seen]:
        for name, part in dict(value).items():
            if isinstance(part, Mapping):
                yield from self._see_info(part, (*path, name))
                continue
            symbols = as_symbols(self._graph, part)
            if symbols.ndim == 0:
                symbols = symbols.like(np.broadcast_to(symbols.cells, (LANES,)))
            yield (*path, name), same_for_all(symbols), symbols.dtype


def _stores(parts: list[_Seen]) -> list[Store]:
    """The values to store in one array after the other."""
    return [
        Store(int(node), None, (number, place, nodes.size))
        for number, (_, nodes, _) in enumerate(parts)
        for place, node in enumerate(nodes.reshape(-1))
    ]


@contextmanager
def in_hook(env: FMUEnv, name: str) -> Iterator[None]:
    """Call a hook on symbols: what it raises becomes an ``UntraceableError`` with its place."""
    try:
        yield
    except Exception as error:  # hooks do with numbers what symbols cannot do
        raise UntraceableError(_placed(env, name, error)) from error


def require_unchanged(contents: Contents) -> None:
    """Raise an ``UntraceableError`` if a hook has changed an attribute in place."""
    changes = contents.changes()
    if changes.inside is not None:
        raise UntraceableError(f"it changes self.{changes.inside}")
    outside = changes.outside or changes.added
    if outside is not None:
        raise UntraceableError(f"it changes {outside}, which all environments share")


def _placed(env: FMUEnv, name: str, error: Exception) -> str:
    """Say where a hook does what cannot be traced."""
    what = str(error) if isinstance(error, UntraceableError) else f"it fails on symbols: {error}"
    code = getattr(getattr(type(env), name), "__code__", None)
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f.lineno for f in frames if code is not None and f.filename == code.co_filename]
    where = f", line {lines[-1]}" if lines else ""
    return f"{name}{where}: {what}"


def tables_of(env: FMUEnv) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """The arrays among the attributes, of the class too, that hooks may index with values."""
    of_classes = {name: v for cls in reversed(type(env).__mro__) for name, v in vars(cls).items()}
    for name, value in (of_classes | vars(env)).items():
        if is_table(value) and not name.startswith("_") and name not in READINGS:
            yield name, value
