"""numpy's functions for symbolic arrays.

A function that is missing here cannot be traced. Sums add their terms in the order in which they
are written, as numpy does along any axis but the one that is contiguous in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, Final

import numpy as np

from fmugym.expressions.graph import Graph
from fmugym.expressions.program import UntraceableError, is_function, letter_of, operation_of
from fmugym.vector.hooks import products, tables
from fmugym.vector.hooks.symbols import (
    Symbols,
    as_symbols,
    asarray,
    each,
    graph_of,
    handlers,
    lift,
)

__all__ = ["COMPOSED", "full_like"]

# Functions element by element.


def call_ufunc(
    graph: Graph, ufunc: Any, method: str, inputs: tuple[Any, ...], keywords: dict[str, Any]
) -> Any:
    """Do what numpy's ``__array_ufunc__`` asks for."""
    (out,) = keywords.pop("out", (None,))
    if ufunc is np.divmod and method == "__call__" and not keywords:
        return np.floor_divide(*inputs), np.remainder(*inputs)
    if ufunc is np.matmul and method == "__call__":
        result = products.matmul(*inputs, **keywords)
    elif method == "__call__" and ufunc.nout == 1 and ufunc.signature is None:
        result = _applied(graph, ufunc, inputs, **keywords)
    elif method == "reduce":
        result = _reduced(graph, ufunc, *inputs, **keywords)
    else:
        name = ufunc.__name__ if method == "__call__" else f"{ufunc.__name__}.{method}"
        raise UntraceableError(f"it uses numpy.{name}")
    return result if out is None else _into(out, result)


def _into(out: Any, result: Symbols) -> Any:
    if not isinstance(out, Symbols):
        raise UntraceableError("it writes to an array that is not made of the values of this step")
    if not np.can_cast(result.dtype, out.dtype, "same_kind"):
        raise UntraceableError(f"it writes {result.dtype} to an array of {out.dtype}")
    out[...] = result
    return out


def _kind_of(graph: Graph, value: Any) -> Any:
    """The type of an operand; the numbers of Python adapt to the other operands."""
    return type(value) if type(value) in (int, float) else as_symbols(graph, value).dtype


def _type_of(graph: Graph, values: Sequence[Any]) -> np.dtype[Any]:
    """The type to which numpy converts all of some values."""
    kinds = [_kind_of(graph, value) for value in values]
    dtype = np.result_type(*(kind(1) if isinstance(kind, type) else kind for kind in kinds))
    letter_of(dtype)
    return dtype


def _operand(graph: Graph, value: Any, dtype: np.dtype[Any]) -> Symbols:
    if type(value) in (int, float):
        return lift(graph, asarray(value, dtype))
    return as_symbols(graph, value).cast(dtype)


def _applied(
    graph: Graph,
    ufunc: Any,
    inputs: tuple[Any, ...],
    dtype: Any = None,
    casting: Any = "same_kind",
    where: Any = True,
    subok: bool = True,
) -> Symbols:
    if where is not True:
        raise UntraceableError(f"it uses numpy.{ufunc.__name__} with where: use numpy.where")
    *types, result = _types_of(graph, ufunc, inputs, dtype)
    operands = [_operand(graph, value, t) for value, t in zip(inputs, types, strict=True)]
    values = _computed(graph, ufunc, operands, result)
    if values.dtype != result:
        raise UntraceableError(f"it uses numpy.{ufunc.__name__} of {types[0]}")
    return values


def _types_of(
    graph: Graph, ufunc: Any, inputs: tuple[Any, ...], dtype: Any
) -> tuple[np.dtype[Any], ...]:
    """The types of the loop that numpy would choose, the result last."""
    kinds = [_kind_of(graph, value) for value in inputs]
    signature = {} if dtype is None else {"signature": (*(None for _ in inputs), np.dtype(dtype))}
    types: tuple[np.dtype[Any], ...] = ufunc.resolve_dtypes((*kinds, None), **signature)
    for one in types:
        letter_of(one)
    return types


def _computed(
    graph: Graph, ufunc: Any, operands: Sequence[Symbols], result: np.dtype[Any]
) -> Symbols:
    """Values of a function by its operation, by that of a wider type, or composed of others."""
    dtype = operands[0].dtype
    wider = np.dtype(np.bool_) if ufunc in _LOGICAL else _WIDER.get(dtype, dtype)
    if ufunc in _POWERS and result.kind == "f" and _is_two(graph, operands[1]):
        base: Any = operands[0].cast(result)
        squares: Symbols = base * base  # as numpy computes them
        return squares
    is_missing = operation_of(ufunc, letter_of(dtype)) is None
    operation = operation_of(ufunc, letter_of(wider))
    if is_missing and operation is not None:
        if is_function(operation):
            graph.tolerate(dtype)  # numpy computes it with the type that it has
        wide = [one.cast(wider) for one in operands]
        kept = wider if result == np.float32 else result
        return _computed(graph, ufunc, wide, kept).cast(result)
    if is_missing and ufunc in _MADE_OF:
        composed: Symbols = _MADE_OF[ufunc](*operands)
        return composed
    cells = [one.cells for one in operands]
    return Symbols(graph, each(lambda *some: graph.apply(ufunc, some, result), *cells), result)


def _is_two(graph: Graph, exponent: Symbols) -> bool:
    return exponent.ndim == 0 and graph.value(exponent.cells.item()) == 2.0


_POWERS: Final = {np.power, np.float_power}

_LOGICAL: Final = {np.logical_and, np.logical_or, np.logical_xor, np.logical_not}

_WIDER: Final[Mapping[Any, np.dtype[Any]]] = {
    np.dtype(np.float32): np.dtype(np.float64),
    np.dtype(np.bool_): np.dtype(np.int64),
}


def _same(x: Any) -> Any:
    return x


def _ratio(x: Any, first: float, second: float) -> Any:
    """A quotient in the type of some values."""
    return x.dtype.type(first) / x.dtype.type(second)


def _sign(x: Any) -> Any:
    return np.where(x > 0, 1, np.where(x < 0, -1, x + 0)).astype(x.dtype)


def _whole_power(base: Any, exponent: Any) -> Any:
    """Multiply an integer by itself; a negative power would be an error."""
    known = {base.graph.value(cell) for cell in exponent.cells.reshape(-1)}
    (times,) = known if len(known) == 1 else (None,)
    if times is None or not 0 <= times <= _LARGEST_POWER:
        raise UntraceableError("it raises integers to a power that is not a small constant")
    result = np.ones_like(base)
    for _ in range(times):
        result = result * base
    return result


_LARGEST_POWER: Final = 64

_MADE_OF: Final[Mapping[Any, Callable[..., Any]]] = {
    **dict.fromkeys((np.floor, np.ceil, np.trunc, np.conjugate), _same),
    **dict.fromkeys((np.degrees, np.rad2deg), lambda x: x * _ratio(x, 180.0, np.pi)),
    **dict.fromkeys((np.radians, np.deg2rad), lambda x: x * _ratio(x, np.pi, 180.0)),
    import_module("numpy._core._multiarray_umath").clip: lambda x, low, high: np.minimum(
        high, np.maximum(low, x)
    ),
    np.absolute: lambda x: np.where(x < 0, -x, x),
    np.fabs: abs,
    np.square: lambda x: x * x,
    np.reciprocal: lambda x: 1.0 / x,
    np.isnan: lambda x: x != x,
    np.isinf: lambda x: (x == x) & (x - x != 0),
    np.isfinite: lambda x: x - x == 0,
    np.signbit: lambda x: np.copysign(1.0, x) < 0,
    np.sign: _sign,
    np.power: _whole_power,
}
"""Functions that others make up, of values without an operation of their own."""


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
    if where is not True or initial not in (None, np._NoValue):
        raise UntraceableError(f"it uses an argument of numpy.{ufunc.__name__}.reduce")
    symbols = as_symbols(graph, array)
    wanted = ufunc.reduce(np.ones(1, symbols.dtype), dtype=dtype).dtype
    axes = range(symbols.ndim) if axis is None else (axis,) if np.ndim(axis) == 0 else axis
    places = sorted(np.atleast_1d(np.arange(symbols.ndim)[list(axes)]).tolist())
    cells = np.moveaxis(symbols.cells, places, range(len(places)))
    rest = cells.shape[len(places) :]
    terms = [symbols.like(row).cast(wanted) for row in cells.reshape(-1, *rest)]
    if ufunc.identity is not None:
        terms.insert(0, lift(graph, np.full(rest, ufunc.identity, wanted)))
    total: Any = _row_of(ufunc, terms)
    lengths = [1 if i in places else n for i, n in enumerate(symbols.shape)]
    result: Symbols = total.like(total.cells.reshape(lengths)) if keepdims else total
    return result


def _row_of(ufunc: Any, terms: Sequence[Any]) -> Any:
    if not terms:
        raise ValueError("reduction operation has no identity: it needs a term")
    total = terms[0]
    for term in terms[1:]:
        total = ufunc(total, term)
    return total


# Functions of arrays.


def call_function(function: Any, args: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
    """Do what numpy's ``__array_function__`` asks for."""
    own = _OWN.get(function)
    if own is not None:
        return own(*args, **keywords)
    if function in _REARRANGING:
        return _rearranged(function, args, keywords)
    if function in COMPOSED:
        return function._implementation(*args, **keywords)
    raise UntraceableError(f"it uses {function.__module__}.{function.__name__}")


def _rearranged(function: Any, args: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
    """Apply a function that moves elements without a look at them."""
    first, *rest = args
    graph = graph_of(first)
    is_list = isinstance(first, list | tuple)
    parts = [as_symbols(graph, part) for part in first] if is_list else [as_symbols(graph, first)]
    dtype = np.result_type(*(part.dtype for part in parts))
    cells = [part.cast(dtype).cells for part in parts]
    result = function(cells if is_list else cells[0], *rest, **keywords)
    if isinstance(result, list | tuple):
        return type(result)(parts[0].like(part, dtype) for part in result)
    return Symbols(graph, np.asarray(result, object), dtype)


def _broadcast_arrays(*arrays: Any, subok: bool = False) -> Any:
    graph = graph_of(*arrays)
    symbols = [as_symbols(graph, array) for array in arrays]
    shaped = np.broadcast_arrays(*(one.cells for one in symbols))
    return tuple(one.like(cells) for one, cells in zip(symbols, shaped, strict=True))


def _where(condition: Any, first: Any, second: Any) -> Symbols:
    graph = graph_of(condition, first, second)
    dtype = _type_of(graph, (first, second))
    chosen = as_symbols(graph, condition).cast(np.bool_)
    values = [_operand(graph, value, dtype) for value in (first, second)]
    cells = each(graph.choose, chosen.cells, *(one.cells for one in values))
    return Symbols(graph, cells, dtype)


def _select(condlist: Any, choicelist: Any, default: Any = 0) -> Any:
    graph = graph_of(condlist, choicelist, default)
    dtype = _type_of(graph, [*choicelist, default])
    result: Any = as_symbols(graph, default).cast(dtype)
    for condition, choice in zip(reversed(condlist), reversed(choicelist), strict=True):
        result = _where(condition, as_symbols(graph, choice).cast(dtype), result)
    return result


def full_like(
    a: Any,
    fill_value: Any,
    dtype: Any = None,
    order: Any = "K",
    subok: Any = True,
    shape: Any = None,
    device: Any = None,
) -> Symbols:
    """Do what ``numpy.full_like`` does."""
    graph = graph_of(a, fill_value)
    like = as_symbols(graph, a)
    wanted = like.dtype if dtype is None else np.dtype(dtype)
    result = lift(graph, np.zeros(like.shape if shape is None else shape, wanted))
    result[...] = fill_value
    return result


def _filled(value: Any) -> Callable[..., Symbols]:
    return lambda a, *args, **keywords: full_like(a, value, *args, **keywords)


def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:  # noqa: A002  (numpy's)
    """The length of vectors; numpy computes others with its linear algebra."""
    if axis is None or np.ndim(axis) != 0 or ord not in (None, 2):
        raise UntraceableError("it uses numpy.linalg.norm without one axis, or not of lengths")
    symbols = x if x.dtype.kind == "f" else x.astype(np.float64)
    return np.sqrt(np.sum(symbols * symbols, axis=axis, keepdims=keepdims))


def _arg_extreme(is_better: Any) -> Callable[..., Symbols]:
    """The index of the first extreme value, or of the first NaN."""

    def find(a: Any, axis: Any = None, out: Any = None, *, keepdims: Any = False) -> Any:
        symbols = as_symbols(graph_of(a), a)
        if out is not None or keepdims is True:
            raise UntraceableError("it uses an argument of numpy.argmax or numpy.argmin")
        cells = symbols.cells.ravel() if axis is None else np.moveaxis(symbols.cells, axis, 0)
        best: Any = symbols.like(cells[0])
        index: Any = np.zeros_like(best, np.intp)
        for number, row in enumerate(map(symbols.like, cells[1:]), 1):
            better = (is_better(row, best) | (row != row)) & (best == best)
            best, index = np.where(better, row, best), np.where(better, np.intp(number), index)
        return index

    return find


handlers.update(ufunc=call_ufunc, function=call_function)

_OWN: Final[Mapping[Any, Callable[..., Any]]] = {
    **tables.FUNCTIONS,
    **products.FUNCTIONS,
    np.where: _where,
    np.select: _select,
    np.argmax: _arg_extreme(np.greater),
    np.argmin: _arg_extreme(np.less),
    np.linalg.norm: _norm,
    np.zeros_like: _filled(0),
    np.empty_like: _filled(0),
    np.ones_like: _filled(1),
    np.full_like: full_like,
    np.broadcast_arrays: _broadcast_arrays,
    np.shape: lambda a: as_symbols(graph_of(a), a).shape,
    np.ndim: lambda a: as_symbols(graph_of(a), a).ndim,
    np.size: lambda a, axis=None: a.size if axis is None else a.shape[axis],
    np.copy: lambda a, order="K", subok=False: a.copy(),
    np.result_type: lambda *values: np.result_type(
        *(np.empty(0, v.dtype) if isinstance(v, Symbols) else v for v in values)
    ),
}

_REARRANGING: Final = frozenset(
    {np.reshape, np.ravel, np.transpose, np.moveaxis, np.rollaxis, np.swapaxes, np.expand_dims}
    | {np.squeeze, np.broadcast_to, np.stack, np.vstack, np.hstack, np.dstack, np.column_stack}
    | {np.concatenate, np.atleast_1d, np.atleast_2d, np.atleast_3d, np.flip, np.fliplr, np.flipud}
    | {np.roll, np.rot90, np.tile, np.repeat, np.split, np.array_split, np.hsplit, np.vsplit}
    | {np.diagonal, np.delete}
)
"""Functions whose first argument is an array or a list of arrays, and that move elements."""

COMPOSED: Final = frozenset(
    {np.sum, np.prod, np.mean, np.std, np.var, np.any, np.all, np.max, np.min, np.amax, np.amin}
    | {np.round, np.around, np.clip, np.ptp, np.diff, np.polyval, np.isclose, np.append}
    | {np.average, np.fix, np.count_nonzero}
)
"""Functions that numpy composes of others."""
