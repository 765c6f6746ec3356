"""Symbolic arrays: hooks compute with them, and a graph records what they compute.

A symbolic array is an array of numpy whose elements are cells of a graph. The environments lie on
an axis of ``LANES`` places, as those of a batch do. numpy's operators and functions arrive at
``__array_ufunc__`` and ``__array_function__``. The memory of the array itself has a shape that
fits nothing, so that code that does not ask these methods fails instead of reading it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.expressions.graph import Cell, Graph
from fmugym.expressions.program import UntraceableError, letter_of

__all__ = [
    "LANES",
    "Symbols",
    "as_symbols",
    "asarray",
    "each",
    "graph_of",
    "handlers",
    "has_symbols",
    "lift",
    "loaded",
    "loaded_rows",
    "same_cells",
    "same_for_all",
    "spread",
]

LANES: Final = 5
"""How many environments a trace has. Two would show whether they are mixed."""

NOWHERE: Final = 1_000_003
"""A length that no array has."""

_MOST_ELEMENTS: Final = 20_000

empty: Final = np.empty
asarray: Final = np.asarray
"""These are quick also while hooks are traced, when others stand in their places in numpy."""

_KEPT: Final = frozenset(
    {"sum", "prod", "min", "max", "any", "all", "clip", "mean", "var", "std", "astype"}
    | {"conj", "conjugate", "dtype", "itemsize"}
)
"""What of ``numpy.ndarray`` works here, because it ends in one of the three methods of numpy."""

_REFUSED: Final = frozenset(
    {"__array__", "__array_namespace__", "__array_prepare__", "__buffer__", "__contains__"}
    | {"__delitem__", "__dlpack__", "__dlpack_device__", "__imatmul__", "__reduce__"}
    | {"__reduce_ex__", "__setstate__"}
)
"""The special methods that do not; all others are Python's operators, or look at no element."""


handlers: Final[dict[str, Callable[..., Any]]] = {}
"""What does the work of numpy's functions, by the kind of request; from the module functions."""


_memory_shape: Any = vars(np.ndarray)["shape"].__get__


class Symbols(np.ndarray[Any, Any]):
    """An array of values that are not known yet.

    Args:
        graph: Records the operations.
        cells: The elements, an array of objects.
        dtype: Their type.
        writeable: Whether hooks may assign to elements.
    """

    _cells: npt.NDArray[Any] | None
    _graph: Graph
    writeable: bool

    def __new__(
        cls, graph: Graph, cells: npt.NDArray[Any], dtype: npt.DTypeLike, writeable: bool = True
    ) -> Symbols:
        """Make an array whose own memory is not used."""
        if cells.size > _MOST_ELEMENTS:
            raise UntraceableError("it computes with a large array")
        symbols: Symbols = super().__new__(cls, (0, NOWHERE), dtype)
        symbols._graph, symbols._cells, symbols.writeable = graph, cells, writeable
        return symbols

    def __array_finalize__(self, parent: Any) -> None:
        """Take over the values if numpy makes a copy, perhaps of another type."""
        self._cells = None
        if not isinstance(parent, Symbols) or parent._cells is None:
            return
        if _memory_shape(self) != (0, NOWHERE):
            return
        self._graph, self.writeable = parent._graph, True
        self._cells = each(lambda cell: self._graph.cast(cell, self.dtype), parent._cells)

    @property
    def cells(self) -> npt.NDArray[Any]:
        """The elements, an array of objects."""
        if self._cells is None:
            raise UntraceableError("it rearranges an array in a way that cannot be followed")
        return self._cells

    @property
    def graph(self) -> Graph:
        """The graph that records the operations."""
        return self._graph

    def cast(self, dtype: npt.DTypeLike) -> Symbols:
        """The values in another type."""
        wanted = np.dtype(dtype)
        return self.like(each(lambda cell: self._graph.cast(cell, wanted), self.cells), wanted)

    def like(self, cells: Any, dtype: npt.DTypeLike | None = None) -> Symbols:
        """An array with other cells of the same graph."""
        array = cells
        if not isinstance(cells, np.ndarray):
            array = empty((), object)
            array[()] = cells
        return Symbols(self._graph, array, self.dtype if dtype is None else dtype, self.writeable)

    # What numpy asks.

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **keywords: Any) -> Any:
        return handlers["ufunc"](self._graph, ufunc, method, inputs, keywords)

    def __array_function__(self, function: Any, types: Any, args: Any, keywords: Any) -> Any:
        return handlers["function"](function, args, keywords)

    # What an array has; more is below.

    def __len__(self) -> int:
        return len(self.cells)

    def __iter__(self) -> Iterator[Any]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, key: Any) -> Any:
        if not has_symbols(key):
            return self.like(self.cells[key])
        if _is_mask(key):
            raise UntraceableError("it uses the values that a condition selects: use numpy.where")
        return handlers["index"](self, key)

    def __setitem__(self, key: Any, value: Any) -> None:
        if not self.writeable:
            raise UntraceableError("it changes an array in place that it may only read")
        if not has_symbols(key):
            new = as_symbols(self._graph, value).cast(self.dtype)
            self.cells[key] = new.cells if new.ndim else new.cells[()]
            return
        if not _is_mask(key):
            raise UntraceableError("it assigns to elements that a value selects")
        place, mask = self._masked(key)
        if np.size(value) != 1:
            raise UntraceableError("it assigns several values to elements that a condition selects")
        new = as_symbols(self._graph, value).cast(self.dtype)
        chosen: Any = np.where(mask, new.like(new.cells.reshape(())), self.like(place))
        place[...] = chosen.cells

    def _masked(self, key: Any) -> tuple[npt.NDArray[Any], Symbols]:
        """The part of the cells that a mask refers to, and the mask in its shape."""
        keys = key if isinstance(key, tuple) else (key,)
        place: npt.NDArray[Any] = self.cells[keys[:-1]]
        mask: Any = keys[-1]
        if keys[:-1] and mask.ndim == 1 and place.ndim > 1:
            mask = mask.like(np.broadcast_to(mask.cells, place.shape))
        if mask.shape != place.shape or not np.shares_memory(place, self.cells):
            raise UntraceableError("it selects elements by a condition of another shape")
        return place, mask

    def _copy(self, *_: Any, **__: Any) -> Symbols:
        return Symbols(self._graph, self.cells.copy(), self.dtype)

    def _fill(self, value: Any) -> None:
        self[...] = value

    def _round(self, decimals: int = 0, out: Any = None) -> Any:
        if self.dtype.kind != "f" or decimals < 0 or out is not None:
            raise UntraceableError("it rounds integers, or to tens")
        factor = 10.0**decimals
        return np.rint(self * factor) / factor if decimals else np.rint(self)

    def _item(self, *_: Any) -> Any:
        raise UntraceableError("it turns a value into a number of Python")

    def __bool__(self) -> bool:
        raise UntraceableError("it branches on a value")

    def __deepcopy__(self, memo: Any) -> Symbols:
        return self._copy()

    __float__ = __int__ = __index__ = __complex__ = _item
    __hash__ = None


def _refusing(name: str) -> Any:
    def refuse(self: Any, *_: Any, **__: Any) -> Any:
        raise UntraceableError(f"it uses the attribute {name} of an array")

    return refuse


def _of_cells(name: str) -> property:
    return property(lambda self: getattr(self.cells, name))


def _moving(name: str) -> Callable[..., Symbols]:
    return lambda self, *args, **keywords: self.like(getattr(self.cells, name)(*args, **keywords))


def _calling(name: str) -> Callable[..., Any]:
    return lambda self, *args, **keywords: getattr(np, name)(self, *args, **keywords)


_METHODS: Final[Mapping[str, Any]] = {
    **{name: _of_cells(name) for name in ("shape", "ndim", "size")},
    **{name: _moving(name) for name in ("reshape", "ravel", "flatten", "transpose", "repeat")},
    **{name: _moving(name) for name in ("swapaxes", "squeeze")},
    "T": property(lambda self: self.like(self.cells.T)),
    "copy": Symbols._copy,
    "__copy__": Symbols._copy,
    **{name: _calling(name) for name in ("take", "dot", "argmax", "argmin")},
    "round": Symbols._round,
    "fill": Symbols._fill,
    "item": Symbols._item,
    "tolist": Symbols._item,
}
"""Methods and properties of arrays that only move elements, or that symbols have of their own."""

for _name in dir(np.ndarray):
    _works = _name not in _REFUSED if _name.startswith("__") else _name in _KEPT
    if _name in _METHODS:
        setattr(Symbols, _name, _METHODS[_name])
    elif not _works and _name not in vars(Symbols):
        is_method = callable(getattr(np.ndarray, _name))
        setattr(Symbols, _name, _refusing(_name) if is_method else property(_refusing(_name)))


def _is_mask(key: Any) -> bool:
    """Whether a key is a condition, perhaps behind keys for the axes before its own."""
    *others, last = key if isinstance(key, tuple) else (key,)
    if not isinstance(last, Symbols) or last.dtype != np.bool_:
        return False
    return all(isinstance(other, int | slice) or other is Ellipsis for other in others)


def each(function: Callable[..., Cell], *cells: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Apply a function element by element to arrays of cells, which are broadcast.

    What it makes of the same nodes in another lane is the same node; so it is called once for them.
    """
    together = np.broadcast(*cells)
    result = empty(together.shape, object)
    flat = result.reshape(-1)
    known: dict[tuple[int, ...], int] = {}
    for index, elements in enumerate(together):
        nodes = tuple([cell.node for cell in elements])
        if nodes in known:
            lanes = {cell.lane for cell in elements if cell.lane is not None}
            if len(lanes) == 1:
                flat[index] = Cell(known[nodes], *lanes)
                continue
        flat[index] = cell = function(*elements)
        if cell.lane is not None:
            known[nodes] = cell.node
    return result


def has_symbols(value: Any) -> bool:
    """Whether a value is symbols, or a list that holds some."""
    if isinstance(value, list | tuple):
        return any(map(has_symbols, value))
    return isinstance(value, Symbols)


def graph_of(*values: Any) -> Graph:
    """The graph of the first symbols among some values.

    Raises:
        UntraceableError: If there are none.
    """
    for value in values:
        if isinstance(value, Symbols):
            return value.graph
        if isinstance(value, list | tuple) and has_symbols(value):
            return graph_of(*value)
    raise UntraceableError("it calls a function of numpy in a way that cannot be followed")


def as_symbols(graph: Graph, value: Any) -> Symbols:
    """Make symbols of numbers, arrays of numbers, and lists of them.

    Raises:
        UntraceableError: If it is anything else.
    """
    if isinstance(value, Symbols):
        return value
    if isinstance(value, list | tuple) and has_symbols(value):
        parts = [as_symbols(graph, part) for part in value]
        if len({part.shape for part in parts}) > 1:
            raise UntraceableError("it makes an array of parts of different shapes")
        dtype = np.result_type(*(part.dtype for part in parts))
        return Symbols(graph, np.stack([part.cast(dtype).cells for part in parts]), dtype)
    return lift(graph, asarray(value))


def lift(graph: Graph, array: npt.NDArray[Any]) -> Symbols:
    """Make symbols of the constants in an array."""
    if isinstance(array, Symbols):
        return array
    if NOWHERE in array.shape:
        raise UntraceableError(
            "it gives values to a function of numpy that cannot be followed. A method such as "
            "numpy.maximum.reduce needs numpy.array around a list; a table in another object needs "
            "numpy.take(table, index)"
        )
    if array.dtype.kind not in "biuf":
        raise UntraceableError(f"it computes with {array.dtype}")
    letter_of(array.dtype)
    if array.size > _MOST_ELEMENTS:
        raise UntraceableError("it computes with a large array")
    cells = np.fromiter((graph.constant(value, array.dtype) for value in array.flat), object)
    return Symbols(graph, cells.reshape(array.shape), array.dtype)


def loaded(
    graph: Graph,
    kind: str,
    shape: tuple[int, ...],
    name: Callable[[int], Hashable],
    dtype: npt.DTypeLike,
) -> Symbols:
    """Symbols for values that a program loads, the environments on the last axis.

    Args:
        graph: Records the operations.
        kind: The kind of node.
        shape: Their shape in one environment.
        name: Tells what an element is, from its number in row-major order.
        dtype: Their type.
    """
    loads = (graph.load(kind, name(index), dtype, None) for index in range(math.prod(shape)))
    nodes = np.fromiter((cell.node for cell in loads), np.int64)
    return spread(graph, nodes.reshape(shape), dtype, writeable=False)


def loaded_rows(
    graph: Graph, shape: tuple[int, ...], *head: Any, dtype: npt.DTypeLike = np.float64
) -> Symbols:
    """Symbols for the rows of an array; a row's name is the head and its number."""
    return loaded(graph, "row", shape, lambda index: (*head, index), dtype)


def spread(
    graph: Graph, nodes: npt.NDArray[Any], dtype: npt.DTypeLike, writeable: bool = True
) -> Symbols:
    """Symbols of nodes, the environments on the last axis."""
    lanes = (Cell(node, lane) for node in nodes.reshape(-1).tolist() for lane in range(LANES))
    cells = np.fromiter(lanes, object).reshape(*nodes.shape, LANES)
    return Symbols(graph, cells, dtype, writeable)


def same_cells(first: Symbols, second: Symbols) -> bool:
    """Whether two arrays have the same values in the same places."""
    pairs = zip(first.cells.flat, second.cells.flat, strict=True)
    return all((one.node, one.lane) == (other.node, other.lane) for one, other in pairs)


def same_for_all(symbols: Symbols) -> npt.NDArray[Any]:
    """The nodes of an array that has the environments on its last axis.

    Returns:
        Their numbers, an array of the shape without that axis.

    Raises:
        UntraceableError: If environments differ in more than their values.
    """
    cells = symbols.cells
    if cells.shape[-1:] != (LANES,):
        raise UntraceableError(f"a result has the shape {cells.shape}, environments last")
    rows = cells.reshape(-1, LANES)
    for row in rows:
        if len({cell.node for cell in row}) > 1 or any(
            cell.lane not in (None, lane) for lane, cell in enumerate(row)
        ):
            raise UntraceableError("it treats environments differently")
    return np.fromiter((row[0].node for row in rows), np.int64).reshape(cells.shape[:-1])
