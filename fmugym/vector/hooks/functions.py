"""numpy's functions for symbolic arrays.

A function that is missing here cannot be traced. Sums add their terms in the order in which they
are written, as numpy does along any axis but the one that is contiguous in memory.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.vector.hooks.graph import Graph
from fmugym.vector.hooks.program import UntraceableError, letter_of
from fmugym.vector.hooks.symbols import (
    LANES,
    Symbols,
    Unboxed,
    as_symbols,
    each,
    handlers,
    has_symbols,
    lift,
)

__all__ = ["numpy_of"]

_MATRIX: Final = "the order of its sums depends on the linear algebra library: write them out"

# Functions element by element.


def call_ufunc(
    graph: Graph, ufunc: Any, method: str, inputs: tuple[Any, ...], keywords: dict[str, Any]
) -> Any:
    """Do what numpy's ``__array_ufunc__`` asks for."""
    if ufunc in {np.matmul, np.vecdot, getattr(np, "matvec", None), getattr(np, "vecmat", None)}:
        raise UntraceableError(f"it uses numpy.{ufunc.__name__}: {_MATRIX}")
    out = keywords.pop("out", None)
    if method == "__call__":
        result = _applied(graph, ufunc, inputs, **keywords)
    elif method == "reduce":
        result = _reduced(graph, ufunc, *inputs, **keywords)
    elif method == "accumulate":
        result = _accumulated(graph, ufunc, *inputs, **keywords)
    else:
        raise UntraceableError(f"it uses numpy.{ufunc.__name__}.{method}")
    return result if out is None or out[0] is None else _into(out[0], result)


def _into(out: Any, result: Symbols) -> Any:
    if not isinstance(out, Symbols):
        raise UntraceableError("it writes to an array that is not made of the values of this step")
    if not np.can_cast(result.dtype, out.dtype, "same_kind"):
        raise UntraceableError(f"it writes {result.dtype} to an array of {out.dtype}")
    out[...] = result
    return out


def _kind_of(value: Any) -> Any:
    """The type of an operand; the numbers of Python adapt to the other operands."""
    if isinstance(value, Symbols) and value.weak is not None:
        return value.weak
    return type(value) if type(value) in (int, float) else np.asarray(value).dtype


def _operand(graph: Graph, value: Any, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    if type(value) in (int, float):
        return lift(graph, np.asarray(value, dtype)).cells
    return as_symbols(graph, value).cast(dtype).cells


def _symbols_of(graph: Graph, value: Any) -> Any:
    is_list = isinstance(value, list | tuple)
    return as_symbols(graph, value) if is_list and has_symbols(value) else value


def _applied(
    graph: Graph,
    ufunc: Any,
    inputs: tuple[Any, ...],
    dtype: Any = None,
    casting: Any = "same_kind",
    where: Any = True,
    subok: bool = True,
) -> Symbols:
    if ufunc.nout != 1:
        raise UntraceableError(f"it uses numpy.{ufunc.__name__}, which has two results")
    if where is not True:
        raise UntraceableError("it uses the argument where of a function")
    inputs = tuple(_symbols_of(graph, value) for value in inputs)
    kinds = tuple(_kind_of(value) for value in inputs)
    signature = {} if dtype is None else {"signature": (*(None for _ in inputs), np.dtype(dtype))}
    *types, result = ufunc.resolve_dtypes((*kinds, None), **signature)
    letter_of(result)
    cells = [_operand(graph, value, t) for value, t in zip(inputs, types, strict=True)]
    combined = each(lambda *operands: graph.apply(ufunc, operands, result), *cells)
    return Symbols(graph, combined, result)


def _reduced(
    graph: Graph,
    ufunc: Any,
    array: Any,
    axis: Any = 0,
    dtype: Any = None,
    keepdims: bool = False,
    initial: Any = None,
    where: Any = True,
) -> Symbols:
    """Combine the elements along some axes in their order."""
    symbols = as_symbols(graph, array)
    if where is not True or ufunc.nout != 1:
        raise UntraceableError(f"it uses an argument of numpy.{ufunc.__name__}.reduce")
    sample = ufunc.reduce(np.ones(1, symbols.dtype), dtype=dtype)
    axes = range(symbols.ndim) if axis is None else (axis,) if np.ndim(axis) == 0 else axis
    places = sorted(np.atleast_1d(np.arange(symbols.ndim)[list(axes)]).tolist())
    order = [*places, *(i for i in range(symbols.ndim) if i not in places)]
    cells = symbols.cells.transpose(order)
    rest = cells.shape[len(places) :]
    terms = [symbols.like(row) for row in cells.reshape(-1, *rest)]
    start = _START.get(ufunc) if initial is None or initial is np._NoValue else initial
    total = _folded(ufunc, terms, start, np.dtype(sample.dtype))
    if not keepdims:
        return total
    lengths = [1 if i in places else n for i, n in enumerate(symbols.shape)]
    return total.like(total.cells.reshape(lengths))


_START: Final[Mapping[Any, Any]] = {
    np.add: 0,
    np.multiply: 1,
    np.logical_and: True,
    np.logical_or: False,
}
"""What numpy starts a reduction with; others start with the first element."""


def _folded(ufunc: Any, terms: list[Symbols], start: Any, dtype: np.dtype[Any]) -> Symbols:
    if start is None and not terms:
        raise ValueError("zero-size array to reduction operation which has no identity")
    terms = [term.cast(np.bool_ if dtype == np.bool_ else dtype) for term in terms]
    total: Any = terms[0] if start is None else np.asarray(start, dtype)
    for term in terms[start is None :]:
        total = ufunc(total, term)
    return total if isinstance(total, Symbols) else np.zeros_like(terms[0]) + total


def _accumulated(
    graph: Graph, ufunc: Any, array: Any, axis: Any = 0, dtype: Any = None, **_: Any
) -> Symbols:
    symbols = as_symbols(graph, array)
    wanted = np.dtype(ufunc.reduce(np.ones(1, symbols.dtype), dtype=dtype).dtype)
    rows = [symbols.like(row).cast(wanted) for row in np.moveaxis(symbols.cells, axis, 0)]
    for index in range(1, len(rows)):
        rows[index] = ufunc(rows[index - 1], rows[index])
    return rows[0].like(np.moveaxis(np.stack([row.cells for row in rows]), 0, axis))


# Functions of arrays.


def call_function(function: Any, args: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
    """Do what numpy's ``__array_function__`` asks for."""
    own = _OWN.get(function)
    if own is not None:
        return own(*args, **keywords)
    if function in _REARRANGING:
        return _rearranged(function, args, keywords)
    if function in _COMPOSED:
        return function._implementation(*args, **keywords)
    name = f"{function.__module__}.{function.__name__}"
    reason = f"it uses {name}"
    raise UntraceableError(f"{reason}: {_MATRIX}" if function in _MATRICES else reason)


def _graph_of(*values: Any) -> Graph:
    for value in values:
        if isinstance(value, Symbols):
            return value.graph
        if isinstance(value, Unboxed):
            return value.symbols.graph
        if isinstance(value, list | tuple) and has_symbols(value):
            return _graph_of(*value)
    raise UntraceableError("it calls a function of numpy in a way that cannot be followed")


def _rearranged(function: Any, args: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
    """Apply a function that moves elements without a look at them."""
    first, *rest = args
    graph = _graph_of(first)
    is_list = isinstance(first, list | tuple)
    parts = [as_symbols(graph, part) for part in first] if is_list else [as_symbols(graph, first)]
    dtype = parts[0].dtype
    for part in parts[1:]:
        dtype = np.promote_types(dtype, part.dtype)
    cells = [part.cast(dtype).cells for part in parts]
    result = function(cells if is_list else cells[0], *rest, **keywords)
    if isinstance(result, list | tuple):
        return type(result)(parts[0].like(part, dtype) for part in result)
    return Symbols(graph, np.asarray(result, object), dtype)


def _broadcast_arrays(*arrays: Any, subok: bool = False) -> Any:
    graph = _graph_of(*arrays)
    symbols = [as_symbols(graph, array) for array in arrays]
    shaped = np.broadcast_arrays(*(one.cells for one in symbols))
    return tuple(one.like(cells) for one, cells in zip(symbols, shaped, strict=True))


def _where(condition: Any, first: Any, second: Any) -> Symbols:
    graph = _graph_of(condition, first, second)
    dummies = [_dummy(graph, value) for value in (first, second)]
    dtype = np.where(np.ones(1, np.bool_), *dummies).dtype
    letter_of(dtype)
    chosen = as_symbols(graph, condition).cast(np.bool_)
    cells = [_operand(graph, _symbols_of(graph, value), dtype) for value in (first, second)]
    return Symbols(graph, each(graph.choose, chosen.cells, *cells), dtype)


def _dummy(graph: Graph, value: Any) -> Any:
    """A number or array of the same type, of which numpy makes the same type of result."""
    if type(value) in (int, float, bool):
        return value
    if isinstance(value, Symbols) and value.weak is not None:
        return value.weak(1)
    return np.ones(1, as_symbols(graph, value).dtype)


def _select(condlist: Any, choicelist: Any, default: Any = 0) -> Any:
    graph = _graph_of(condlist, choicelist, default)
    values = [*choicelist, default]
    dtype = np.result_type(*(_dummy(graph, value) for value in values))
    result: Any = as_symbols(graph, default).cast(dtype)
    for condition, choice in zip(reversed(condlist), reversed(choicelist), strict=True):
        result = _where(condition, as_symbols(graph, choice).cast(dtype), result)
    return result


def _clip(a: Any, a_min: Any = None, a_max: Any = None, out: Any = None, **keywords: Any) -> Any:
    low, high = keywords.pop("min", a_min), keywords.pop("max", a_max)
    graph = _graph_of(a, low, high)
    symbols = as_symbols(graph, a)
    if keywords or out is not None:
        raise UntraceableError("it uses an argument of numpy.clip")
    if low is None and high is None:
        return symbols.copy()
    if low is None:
        return np.minimum(symbols, high)
    if high is None:
        return np.maximum(symbols, low)
    return np._core.umath.clip(symbols, low, high)  # type: ignore[attr-defined]


def _filled(value: Any) -> Callable[..., Symbols]:
    def make(
        a: Symbols, dtype: Any = None, order: Any = "K", subok: Any = True, shape: Any = None
    ) -> Any:
        wanted = a.dtype if dtype is None else np.dtype(dtype)
        return lift(a.graph, np.full(a.shape if shape is None else shape, value, wanted))

    return make


def _full_like(a: Any, fill_value: Any, dtype: Any = None, **_: Any) -> Symbols:
    graph = _graph_of(a, fill_value)
    like = as_symbols(graph, a)
    wanted = like.dtype if dtype is None else np.dtype(dtype)
    result = lift(graph, np.zeros(like.shape, wanted))
    result[...] = fill_value
    return result


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:  # noqa: A002  (numpy's)
    """The norm of vectors; numpy computes others with its linear algebra."""
    if axis is None or np.ndim(axis) != 0 or ord not in (None, 2, 1, np.inf):
        raise UntraceableError("it uses numpy.linalg.norm without one axis")
    symbols = x if x.dtype.kind == "f" else x.astype(np.float64)
    add: Any = np.add
    if ord == 1:
        return add.reduce(np.absolute(symbols), axis=axis, keepdims=keepdims)
    if ord == np.inf:
        return np.max(np.absolute(symbols), axis=axis, keepdims=keepdims)
    return np.sqrt(add.reduce(symbols * symbols, axis=axis, keepdims=keepdims))


def _copyto(dst: Any, src: Any, casting: Any = "same_kind", where: Any = True) -> None:
    graph = _graph_of(dst)
    dst[...] = src if where is True else _where(where, as_symbols(graph, src).cast(dst.dtype), dst)


# Tables.


def _interp(
    x: Any, xp: Any, fp: Any, left: Any = None, right: Any = None, period: Any = None
) -> Symbols:
    if period is not None or has_symbols((xp, fp, left, right)):
        raise UntraceableError("numpy.interp has a period, or a table that is not constant")
    graph = _graph_of(x)
    xs, ys = (np.asarray(part, np.float64) for part in (xp, fp))
    if xs.ndim != 1 or xs.shape != ys.shape or not xs.size:
        raise ValueError("fp and xp are not of the same length")
    ends = [ys[0] if left is None else left, ys[-1] if right is None else right]
    table = np.concatenate([xs, ys, np.array(ends, np.float64)])
    number = _place_table(graph, table)
    floats = as_symbols(graph, x).cast(np.float64)

    def fold(values: Any) -> Any:
        return np.interp(values, xs, ys, left, right)

    cells = each(
        lambda cell: graph.compute("interpolate", number, (cell,), np.dtype(np.float64), fold),
        floats.cells,
    )
    return Symbols(graph, cells, np.float64)


def _place_table(graph: Graph, table: npt.NDArray[Any]) -> Any:
    key = table.dtype.char, table.tobytes()
    graph.tables.setdefault(key, table)
    return key


def _take(a: Any, indices: Any, axis: Any = None, out: Any = None, mode: Any = "raise") -> Any:
    graph = _graph_of(a, indices)
    table = as_symbols(graph, a)
    if not has_symbols(indices):
        return table.like(np.take(table.cells, indices, axis))
    if out is not None or mode != "raise":
        raise UntraceableError("it uses an argument of numpy.take")
    if axis is None:
        return look_up(table.like(table.cells.ravel()), indices)
    return np.moveaxis(look_up(np.moveaxis(table, axis, 0), indices), 0, axis)


def look_up(table: Symbols, key: Any) -> Symbols:
    """Index an array with a value: a table of constants along its first axis."""
    keys = key if isinstance(key, tuple) else (key,)
    first = keys[0]
    if not isinstance(first, Symbols) or first.dtype.kind not in "iu" or has_symbols(keys[1:]):
        raise UntraceableError("it indexes an array with values in a way that cannot be followed")
    graph, rows = table.graph, table.cells[(slice(None), *keys[1:])]
    columns = rows.reshape(len(rows), -1)
    index = first.cast(np.int64).cells
    parts = [_column(table, columns[:, i], index) for i in range(columns.shape[1])]
    cells = np.stack(parts, axis=-1).reshape((*index.shape, *rows.shape[1:]))
    return Symbols(graph, cells, table.dtype)


def _column(table: Symbols, column: npt.NDArray[Any], index: npt.NDArray[Any]) -> Any:
    graph = table.graph
    values = [graph.value(cell) for cell in column]
    if any(value is None for value in values):
        raise UntraceableError("it chooses between values by an index: use numpy.where or select")
    constants = np.array(values, table.dtype)
    number = _place_table(graph, constants)
    fold: Any = constants.__getitem__
    return each(lambda cell: graph.compute("take", number, (cell,), table.dtype, fold), index)


handlers.update(ufunc=call_ufunc, function=call_function, index=look_up)

_OWN: Final[Mapping[Any, Callable[..., Any]]] = {
    np.where: _where,
    np.select: _select,
    np.clip: _clip,
    np.interp: _interp,
    np.take: _take,
    np.copyto: _copyto,
    np.linalg.norm: _norm,
    np.zeros_like: _filled(0),
    np.empty_like: _filled(0),
    np.ones_like: _filled(1),
    np.full_like: _full_like,
    np.broadcast_arrays: _broadcast_arrays,
    np.shape: lambda a: as_symbols(_graph_of(a), a).shape,
    np.ndim: lambda a: as_symbols(_graph_of(a), a).ndim,
    np.size: lambda a, axis=None: a.size if axis is None else a.shape[axis],
    np.copy: lambda a, order="K", subok=False: a.copy(),
    np.result_type: lambda *values: np.result_type(
        *(np.empty(0, v.dtype) if isinstance(v, Symbols) else v for v in values)
    ),
    np.iscomplexobj: lambda x: False,
    np.isrealobj: lambda x: True,
    np.real: lambda val: val,
}

_REARRANGING: Final = frozenset(
    {np.reshape, np.ravel, np.transpose, np.moveaxis, np.rollaxis, np.swapaxes, np.expand_dims}
    | {np.squeeze, np.broadcast_to, np.stack, np.vstack, np.hstack, np.dstack, np.column_stack}
    | {np.concatenate, np.atleast_1d, np.atleast_2d, np.atleast_3d, np.flip, np.fliplr, np.flipud}
    | {np.roll, np.rot90, np.tile, np.repeat, np.split, np.array_split, np.hsplit, np.vsplit}
    | {np.diagonal, np.delete}
)
"""Functions whose first argument is an array or a list of arrays, and that move elements."""

_COMPOSED: Final = frozenset(
    {np.sum, np.prod, np.mean, np.std, np.var, np.any, np.all, np.max, np.min, np.amax, np.amin}
    | {np.round, np.around, np.cumsum, np.cumprod, np.ptp, np.diff, np.polyval}
)
"""Functions that numpy composes of others."""

_MATRICES: Final = frozenset(
    {np.dot, np.vdot, np.inner, np.outer, np.einsum, np.tensordot, np.cross, np.linalg.multi_dot}
)

# Functions that do not ask their arguments.

_tracing = threading.local()
_lock = threading.RLock()


def _patched(function: Any, own: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **keywords: Any) -> Any:
        graph = getattr(_tracing, "graph", None)
        if graph is None:
            return function(*args, **keywords)
        return graph.patched(own, function, args, keywords)

    return functools.update_wrapper(call, function)


def _array(
    graph: Graph, function: Any, value: Any, dtype: Any = None, *args: Any, **kw: Any
) -> Any:
    if not has_symbols(value):
        return function(value, dtype, *args, **kw)
    symbols = as_symbols(graph, value)
    wanted = symbols.dtype if dtype is None else np.dtype(dtype)
    is_new = function is _array_function or symbols.dtype != wanted
    return symbols.cast(wanted).copy() if is_new else symbols


def _made(graph: Graph, function: Any, shape: Any, *args: Any, **keywords: Any) -> Any:
    if function is _full_function and has_symbols(args[:1]):
        dtype = keywords.get("dtype", args[1] if len(args) > 1 else None)
        return _full_like(np.zeros(shape), args[0], dtype or as_symbols(graph, args[0]).dtype)
    array = function(shape, *args, **keywords)
    if function is _empty_function:
        array[...] = 0
    is_of_all = array.shape[-1:] == (LANES,) and array.dtype.kind in "biuf"
    return lift(graph, array) if is_of_all else array


def _taken(graph: Graph, function: Any, a: Any, indices: Any, *args: Any, **keywords: Any) -> Any:
    if has_symbols((a, indices)):
        return _take(a, indices, *args, **keywords)
    return function(a, indices, *args, **keywords)


_array_function, _full_function, _empty_function = np.array, np.full, np.empty


def _of_list(graph: Graph, function: Any, a: Any, *args: Any, **keywords: Any) -> Any:
    is_list = isinstance(a, list | tuple) and has_symbols(a)
    return function(as_symbols(graph, a) if is_list else a, *args, **keywords)


_OVERRIDING: Final[Mapping[str, Any]] = {
    **dict.fromkeys(("array", "asarray", "asanyarray", "ascontiguousarray"), _array),
    **dict.fromkeys(("zeros", "ones", "full", "empty"), _made),
    "take": _taken,
    **dict.fromkeys(("sum", "prod", "mean", "std", "var", "any", "all", "max", "min"), _of_list),
    **dict.fromkeys(("amax", "amin", "cumsum", "cumprod", "diff", "ptp", "moveaxis"), _of_list),
    **dict.fromkeys(("transpose", "reshape", "ravel", "flip", "roll", "sort"), _of_list),
}

_PATCHES: Final = [
    *((np, name, _patched(getattr(np, name), own)) for name, own in _OVERRIDING.items()),
    (np.linalg, "norm", _patched(np.linalg.norm, _of_list)),
]
_ORIGINALS: Final = [(module, name, getattr(module, name)) for module, name, _ in _PATCHES]


@contextmanager
def numpy_of(graph: Graph) -> Iterator[None]:
    """Let functions of numpy that do not ask their arguments return symbols, in this thread.

    ``numpy.array`` and a few others cannot be overridden by their arguments, or not by those in
    a list. So they are replaced while hooks are traced. In other threads they do what they always
    do.
    """
    with _lock:
        try:
            for module, name, function in _PATCHES:
                setattr(module, name, function)
            _tracing.graph = graph
            yield
        finally:
            _tracing.graph = None
            for module, name, function in _ORIGINALS:
                setattr(module, name, function)
