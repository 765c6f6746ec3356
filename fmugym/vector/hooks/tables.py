"""Tables: constant arrays that hooks look values up in, by an index or by interpolation."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dis import get_instructions
from functools import lru_cache
from itertools import chain
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.expressions.graph import Cell, Graph
from fmugym.expressions.program import UntraceableError
from fmugym.task.step import ORDER
from fmugym.vector.hooks.symbols import (
    Symbols,
    as_symbols,
    each,
    graph_of,
    handlers,
    has_symbols,
    lift,
)

__all__ = [
    "FUNCTIONS",
    "Table",
    "defaults_of",
    "functions_of",
    "is_foreign",
    "is_table",
    "names_in",
    "places_of",
    "tables_in",
    "unwrapped",
]

_MOST_VALUES: Final = 4096
"""The most elements of a table."""


class Table(np.ndarray[Any, Any]):
    """An array that symbols may index. Hooks find it in the place of a constant array of theirs.

    For everything else it is the same array: it has the same memory.
    """

    def __getitem__(self, key: Any) -> Any:
        if has_symbols(key):
            return look_up(lift(graph_of(key), self.view(np.ndarray)), key)
        return super().__getitem__(key)

    def __array_function__(self, function: Any, types: Any, args: Any, keywords: Any) -> Any:
        if any(issubclass(one, Symbols) for one in types):
            return NotImplemented
        return super().__array_function__(function, types, args, keywords)

    def dot(self, other: Any, out: Any = None) -> Any:
        """Do what the method of an array does."""
        return np.dot(self, other, out)


def is_table(value: Any) -> bool:
    """Whether a value is an array that hooks may index with values."""
    if type(value) is not np.ndarray or value.dtype.kind not in "biuf":
        return False
    return value.dtype.itemsize <= 8 and 0 < value.size <= _MOST_VALUES


# Indexing


def look_up(table: Symbols, key: Any) -> Symbols:
    """Index a constant array with integers for its first axes, as numpy does."""
    graph, constants = table.graph, _known(table.graph, table)
    parts = key if isinstance(key, tuple) else (key,)
    if len(parts) > constants.ndim or not all(map(_are_integers, parts)):
        raise UntraceableError("it indexes an array with values in a way that cannot be followed")
    keys = [as_symbols(graph, part) for part in parts]
    lengths, rest = constants.shape[: len(keys)], constants.shape[len(keys) :]
    index = _flat_index(graph, keys, lengths)
    columns = np.ascontiguousarray(constants.reshape(math.prod(lengths), -1).T)
    found = [each(lambda cell, c=column: _taken(graph, cell, c), index.cells) for column in columns]
    return table.like(np.stack(found, axis=-1).reshape((*index.shape, *rest)))


def _are_integers(key: Any) -> bool:
    return (
        key is not None and (key if isinstance(key, Symbols) else np.asarray(key)).dtype.kind == "i"
    )


def _flat_index(graph: Graph, keys: Sequence[Symbols], lengths: Sequence[int]) -> Symbols:
    """The number of the element in the order of memory. A key outside of its axis is an error."""
    if len(keys) == 1:
        return keys[0]
    strides = [math.prod(lengths[axis + 1 :]) for axis in range(len(lengths))]
    offsets: list[Any] = [
        look_up(lift(graph, np.arange(length) * stride), key)
        for key, length, stride in zip(keys, lengths, strides, strict=True)
    ]
    flat: Symbols = sum(offsets[1:], offsets[0])
    return flat


def _taken(graph: Graph, index: Cell, constants: npt.NDArray[Any]) -> Cell:
    number = _place_table(graph, constants)
    return graph.compute("take", number, (index,), constants.dtype, constants.__getitem__)


def _place_table(graph: Graph, table: npt.NDArray[Any]) -> Any:
    key = table.dtype.char, table.tobytes()
    graph.tables.setdefault(key, table)
    return key


def _take(a: Any, indices: Any, axis: Any = None, out: Any = None, mode: Any = "raise") -> Any:
    graph = graph_of(a, indices)
    table = as_symbols(graph, a)
    if not has_symbols(indices):
        return table.like(np.take(table.cells, indices, axis))
    if out is not None or mode != "raise" or axis not in (None, 0):
        raise UntraceableError("it uses an argument of numpy.take")
    return look_up(table if axis == 0 else table.like(table.cells.ravel()), indices)


# Searching


def _searchsorted(a: Any, v: Any, side: Any = "left", sorter: Any = None) -> Any:
    """Halve the part of a table that a value belongs to, until nothing is left of it."""
    if has_symbols(a) or sorter is not None:
        raise UntraceableError("numpy.searchsorted has a table that is not constant, or a sorter")
    graph, table = graph_of(v), np.asarray(a)
    value = as_symbols(graph, v)
    if np.any(table != table):
        raise UntraceableError("numpy.searchsorted has a table with a NaN")
    dtype = np.promote_types(table.dtype, value.dtype)
    value, table = value.cast(dtype), table.astype(dtype)
    is_before = np.less if side == "left" else np.less_equal
    place: Any = np.zeros_like(value, np.int64)
    for step in (1 << bit for bit in reversed(range(len(table).bit_length()))):
        further = place + step
        known = look_up(lift(graph, table), np.minimum(further, len(table)) - 1)
        place = np.where((further <= len(table)) & is_before(known, value), further, place)
    return np.where(value != value, len(table), place)  # a NaN belongs behind all numbers


# Interpolation


def _interp(
    x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None, period: Any = None
) -> Symbols:
    graph = graph_of(x, xp, fp, left, right)
    xs, ys = (np.asarray(_known(graph, part), np.float64) for part in (xp, fp))
    if xs.ndim != 1 or xs.shape != ys.shape or not xs.size:
        raise ValueError("fp and xp are not of the same length")
    if period is not None or not np.all(xs[:-1] <= xs[1:]):
        raise UntraceableError("numpy.interp has a period, or coordinates that fall")
    sides = ys[0] if left is None else left, ys[-1] if right is None else right
    ends = [_known(graph, side) for side in sides]
    table = np.concatenate([xs, ys, np.array(ends, np.float64)])
    number = _place_table(graph, table)
    floats, double = as_symbols(graph, x).cast(np.float64), np.dtype(np.float64)

    def fold(values: Any) -> Any:
        return np.interp(values, xs, ys, *ends)

    cells = each(
        lambda cell: graph.compute("interpolate", number, (cell,), double, fold), floats.cells
    )
    return Symbols(graph, cells, double)


def _known(graph: Graph, part: Any) -> Any:
    """The numbers of symbols that are all constants; anything else as it is."""
    if not has_symbols(part):
        return part
    symbols = as_symbols(graph, part)
    values = [graph.value(cell) for cell in symbols.cells.reshape(-1)]
    if any(value is None for value in values):
        raise UntraceableError("it looks values up in a table that is not constant")
    return np.array(values, symbols.dtype).reshape(symbols.shape)


handlers.update(index=look_up)

FUNCTIONS: Final[Mapping[Any, Any]] = {
    np.take: _take,
    np.searchsorted: _searchsorted,
    np.interp: _interp,
}
"""The functions of numpy that look values up."""


# Where hooks find their tables


@contextmanager
def tables_in(env: Any) -> Iterator[None]:
    """Let the functions of an environment find a ``Table`` in the place of each constant array.

    These are the arrays that the methods of its class, and functions that these call, refer to by
    a global name, as an attribute of a module or as a variable of a surrounding function.
    """
    functions = functions_of(env)
    places = [place for function in functions for place in places_of(function)]
    held = [(place, name, place[name]) for place, name in places if is_table(place[name])]
    for place, name, value in held:
        place[name] = value.view(Table)
    try:
        yield
    finally:
        for place, name, value in held:
            place[name] = value


class _Variable(dict[str, Any]):
    """The variable of a closure as a dict of one entry."""

    def __init__(self, cell: CellType) -> None:
        super().__init__({"": cell.cell_contents})
        self._cell = cell

    def __getitem__(self, name: str) -> Any:
        return self._cell.cell_contents

    def __setitem__(self, name: str, value: Any) -> None:
        self._cell.cell_contents = value


_OURS: Final = ("fmugym", "gymnasium", "numpy")


def functions_of(env: Any) -> list[FunctionType]:
    """The functions of hooks, and those that they call by name or by an attribute.

    Those of packages are left out.
    """
    attributes: dict[str, Any] = {}
    for holder in (*reversed(type(env).__mro__), env):
        attributes.update(vars(holder))
    waiting = [attributes.get(name) for name in (*ORDER, "_goal_reward")]
    found: dict[int, FunctionType] = {}
    while waiting:
        function = unwrapped(waiting.pop())
        known = not isinstance(function, FunctionType) or id(function) in found
        if known or is_foreign(function.__module__ or ""):
            continue
        found[id(function)] = function
        waiting += [place[name] for place, name in places_of(function)]
        names = [name for name in names_in(function.__code__) if not name.startswith("__")]
        waiting += map(attributes.get, names)
        if "super" in names:
            waiting += [vars(cls).get(name) for cls in type(env).__mro__ for name in names]
    return list(found.values())


def is_foreign(module: str) -> bool:
    """Whether the functions of a module are no part of a user's task."""
    return module.partition(".")[0] in _OURS and not module.startswith("fmugym.envs")


def unwrapped(value: Any) -> Any:
    """The function of a property, a static method and the like."""
    for name in ("fget", "__func__", "func", "__wrapped__"):
        inner = getattr(value, name, None) if not isinstance(value, FunctionType) else None
        value = value if inner is None else inner
    return value


def places_of(function: FunctionType) -> list[tuple[dict[str, Any], str]]:
    """Where a function finds what is not local: dicts and names in them."""
    names = set(names_in(function.__code__))
    spaces = [function.__globals__]
    modules = [function.__globals__.get(name) for name in names]
    modules += map(sys.modules.get, _imports_in(function.__code__))
    spaces += [
        vars(one) for one in modules if isinstance(one, ModuleType) and not is_foreign(one.__name__)
    ]
    places = [(space, name) for space in spaces for name in names if name in space]
    for cell in function.__closure__ or ():
        try:
            places.append((_Variable(cell), ""))
        except ValueError:  # the variable has no value yet
            continue
    return places + [(defaults, name) for defaults in [defaults_of(function)] for name in defaults]


def defaults_of(function: FunctionType) -> dict[str, Any]:
    """The default values of a function's arguments, by the names of these."""
    defaults, count = function.__defaults__ or (), function.__code__.co_argcount
    names = function.__code__.co_varnames[count - len(defaults) : count]
    return dict(zip(names, defaults, strict=True)) | (function.__kwdefaults__ or {})


@lru_cache(maxsize=1024)  # reading instructions takes long
def _imports_in(code: CodeType) -> tuple[str, ...]:
    """The names of the modules that some code imports itself."""
    own = [one.argval for one in get_instructions(code) if one.opname == "IMPORT_NAME"]
    inner = [_imports_in(one) for one in code.co_consts if isinstance(one, CodeType)]
    return (*own, *chain.from_iterable(inner))


def names_in(code: CodeType) -> Iterator[str]:
    """The names of globals and attributes that some code refers to."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from names_in(constant)
