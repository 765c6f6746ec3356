"""numpy's functions for symbolic arrays.

A function that is missing here cannot be traced. Sums add their terms in the order in which they
are written, as numpy does along any axis but the one that is contiguous in memory.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.vector.hooks import nans, products, sorting, tables
from fmugym.vector.hooks.graph import CLIP, Graph
from fmugym.vector.hooks.program import UntraceableError, letter_of
from fmugym.vector.hooks.symbols import (
    Symbols,
    as_symbols,
    each,
    graph_of,
    handlers,
    has_symbols,
    lift,
    stand_in,
)

__all__ = ["full_like"]

# Functions element by element.


def call_ufunc(
    graph: Graph, ufunc: Any, method: str, inputs: tuple[Any, ...], keywords: dict[str, Any]
) -> Any:
    """Do what numpy's ``__array_ufunc__`` asks for."""
    out = keywords.pop("out", None)
    if ufunc in products.UFUNCS and method == "__call__":
        result = products.UFUNCS[ufunc](*inputs, **keywords)
    elif method == "__call__" and ufunc.nout > 1:
        results = _applied_all(graph, ufunc, inputs, **keywords)
        return results if out is None else tuple(map(_into_given, out, results))
    elif method == "__call__":
        result = _applied(graph, ufunc, inputs, out, **keywords)
    elif method == "reduce":
        result = _reduced(graph, ufunc, *inputs, **keywords)
    elif method == "accumulate":
        result = _accumulated(graph, ufunc, *inputs, **keywords)
    else:
        raise UntraceableError(f"it uses numpy.{ufunc.__name__}.{method}")
    return result if out is None else _into_given(out[0], result)


def _into_given(out: Any, result: Symbols) -> Any:
    return result if out is None else _into(out, result)


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
    out: Any = None,
    dtype: Any = None,
    casting: Any = "same_kind",
    where: Any = True,
    subok: bool = True,
) -> Symbols:
    inputs = tuple(_symbols_of(graph, value) for value in inputs)
    *types, result = _types_of(ufunc, inputs, dtype)
    cells = _operands(graph, inputs, types)
    combined = each(lambda *operands: graph.apply(ufunc, operands, result), *cells)
    values = Symbols(graph, combined, result)
    return values if where is True else _where_else(ufunc, where, values, out)


def _types_of(ufunc: Any, inputs: tuple[Any, ...], dtype: Any) -> tuple[np.dtype[Any], ...]:
    """The types of the loop that numpy would choose, the results last."""
    kinds = [_kind_of(value) for value in inputs]
    results = [None] * ufunc.nout
    signature = {} if dtype is None else {"signature": (*(None for _ in inputs), np.dtype(dtype))}
    types: tuple[np.dtype[Any], ...] = ufunc.resolve_dtypes((*kinds, *results), **signature)
    for one in types:
        letter_of(one)
    return types


def _operands(
    graph: Graph, inputs: tuple[Any, ...], types: Sequence[np.dtype[Any]]
) -> list[npt.NDArray[Any]]:
    return [_operand(graph, value, t) for value, t in zip(inputs, types, strict=True)]


def _applied_all(graph: Graph, ufunc: Any, inputs: tuple[Any, ...], **keywords: Any) -> Any:
    """The results of a function that has several."""
    if keywords:
        raise UntraceableError(f"it uses an argument of numpy.{ufunc.__name__}")
    inputs = tuple(_symbols_of(graph, value) for value in inputs)
    types = _types_of(ufunc, inputs, None)
    results = types[ufunc.nin :]
    cells = _operands(graph, inputs, types[: ufunc.nin])

    def part(index: int, dtype: np.dtype[Any]) -> Symbols:
        found = each(lambda *operands: graph.part(ufunc, index, operands, results), *cells)
        return Symbols(graph, found, dtype)

    return tuple(part(index, dtype) for index, dtype in enumerate(results))


def _where_else(ufunc: Any, where: Any, values: Symbols, out: Any) -> Symbols:
    """The values where a condition holds; what was in the output array elsewhere."""
    if out is None or out[0] is None:
        raise UntraceableError(f"it uses numpy.{ufunc.__name__} with where, but without out")
    if not np.can_cast(values.dtype, out[0].dtype, "same_kind"):
        raise UntraceableError(f"it writes {values.dtype} to an array of {out[0].dtype}")
    return _where(where, values.cast(out[0].dtype), out[0])


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
    sample = ufunc.reduce(np.ones(1, symbols.dtype), dtype=dtype)
    axes = range(symbols.ndim) if axis is None else (axis,) if np.ndim(axis) == 0 else axis
    places = sorted(np.atleast_1d(np.arange(symbols.ndim)[list(axes)]).tolist())
    order = [*places, *(i for i in range(symbols.ndim) if i not in places)]
    cells = symbols.cells.transpose(order)
    rest = cells.shape[len(places) :]
    terms = [symbols.like(row) for row in cells.reshape(-1, *rest)]
    start = _START.get(ufunc) if initial is None or initial is np._NoValue else initial
    masks: list[Any] = [True] * len(terms)
    if where is not True:
        mask = as_symbols(graph, where)
        shaped = np.broadcast_to(mask.cells, symbols.shape).transpose(order)
        masks = [mask.like(row) for row in shaped.reshape(-1, *rest)]
    total = _folded(ufunc, terms, masks, start, np.dtype(sample.dtype))
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


def _folded(
    ufunc: Any, terms: list[Symbols], masks: list[Any], start: Any, dtype: np.dtype[Any]
) -> Symbols:
    if start is None and not (terms and masks[0] is True):
        raise ValueError("reduction operation has no identity: it needs a term, or initial")
    terms = [term.cast(np.bool_ if dtype == np.bool_ else dtype) for term in terms]
    total: Any = terms[0] if start is None else np.asarray(start, dtype)
    for term, mask in list(zip(terms, masks, strict=True))[start is None :]:
        longer = ufunc(total, term)
        total = longer if mask is True else _where(mask, longer, total)
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
    raise UntraceableError(f"it uses {function.__module__}.{function.__name__}")


def _rearranged(function: Any, args: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
    """Apply a function that moves elements without a look at them."""
    first, *rest = args
    graph = graph_of(first)
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
    graph = graph_of(*arrays)
    symbols = [as_symbols(graph, array) for array in arrays]
    shaped = np.broadcast_arrays(*(one.cells for one in symbols))
    return tuple(one.like(cells) for one, cells in zip(symbols, shaped, strict=True))


def _where(condition: Any, first: Any, second: Any) -> Symbols:
    graph = graph_of(condition, first, second)
    dummies = [stand_in(graph, value) for value in (first, second)]
    dtype = np.where(np.ones(1, np.bool_), *dummies).dtype
    letter_of(dtype)
    chosen = as_symbols(graph, condition).cast(np.bool_)
    cells = [_operand(graph, _symbols_of(graph, value), dtype) for value in (first, second)]
    return Symbols(graph, each(graph.choose, chosen.cells, *cells), dtype)


def _select(condlist: Any, choicelist: Any, default: Any = 0) -> Any:
    graph = graph_of(condlist, choicelist, default)
    values = [*choicelist, default]
    dtype = np.result_type(*(stand_in(graph, value) for value in values))
    result: Any = as_symbols(graph, default).cast(dtype)
    for condition, choice in zip(reversed(condlist), reversed(choicelist), strict=True):
        result = _where(condition, as_symbols(graph, choice).cast(dtype), result)
    return result


def _clip(a: Any, a_min: Any = None, a_max: Any = None, out: Any = None, **keywords: Any) -> Any:
    low, high = keywords.pop("min", a_min), keywords.pop("max", a_max)
    graph = graph_of(a, low, high)
    symbols = as_symbols(graph, a)
    if keywords:
        raise UntraceableError("it uses an argument of numpy.clip")
    if low is None and high is None:
        result: Any = symbols.copy()
    elif low is None:
        result = np.minimum(symbols, high)
    elif high is None:
        result = np.maximum(symbols, low)
    else:
        result = CLIP(symbols, low, high)
    return result if out is None else _into(out, result)


def _filled(value: Any) -> Callable[..., Symbols]:
    def make(
        a: Symbols, dtype: Any = None, order: Any = "K", subok: Any = True, shape: Any = None
    ) -> Any:
        wanted = a.dtype if dtype is None else np.dtype(dtype)
        return lift(a.graph, np.full(a.shape if shape is None else shape, value, wanted))

    return make


def full_like(a: Any, fill_value: Any, dtype: Any = None, **_: Any) -> Symbols:
    """Do what ``numpy.full_like`` does."""
    graph = graph_of(a, fill_value)
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


def _flat(a: Any, axis: Any) -> tuple[Symbols, int]:
    """Symbols and an axis; without one, numpy takes all elements in a row."""
    symbols = as_symbols(graph_of(a), a)
    if axis is not None:
        return symbols, axis
    return symbols.like(symbols.cells.ravel()), 0


def _accumulating(ufunc: Any) -> Callable[..., Any]:
    def accumulate(a: Any, axis: Any = None, dtype: Any = None, out: Any = None) -> Any:
        symbols, axis = _flat(a, axis)
        return ufunc.accumulate(symbols, axis, dtype, None if out is None else (out,))

    return accumulate


def _arg_extreme(is_better: Any) -> Callable[..., Symbols]:
    """The index of the first extreme value, or of the first NaN."""

    def find(a: Any, axis: Any = None, out: Any = None, *, keepdims: Any = False) -> Any:
        symbols, axis = _flat(a, axis)
        if out is not None:
            raise UntraceableError("it writes the place of an extreme value to an array")
        rows = [symbols.like(row) for row in np.moveaxis(symbols.cells, axis, 0)]
        best: Any = rows[0]
        index: Any = np.zeros_like(best, np.intp)
        for number, row in enumerate(rows[1:], 1):
            better = (is_better(row, best) | (row != row)) & (best == best)
            best, index = np.where(better, row, best), np.where(better, np.intp(number), index)
        return np.expand_dims(index, axis) if keepdims is True else index

    return find


def _piecewise(x: Any, condlist: Any, funclist: Any, *args: Any, **kw: Any) -> Any:
    """Call all functions with all values, where numpy calls each with those that it is for."""
    value = as_symbols(graph_of(x, condlist), x)
    is_single = not isinstance(condlist, list | tuple) and np.ndim(condlist) == value.ndim
    conditions = [condlist] if is_single else list(condlist)
    if len(funclist) == len(conditions) + 1:
        others = np.logical_not(functools.reduce(np.logical_or, conditions))
        conditions = [*conditions, others]
    result: Any = np.zeros_like(value)
    for condition, function in zip(conditions, funclist, strict=True):
        part = function(value, *args, **kw) if callable(function) else function
        result = _where(condition, as_symbols(value.graph, part).cast(value.dtype), result)
    return result


def _isin(
    element: Any, test_elements: Any, assume_unique: Any = False, invert: Any = False, **_: Any
) -> Any:
    value = as_symbols(graph_of(element), element)
    flat = np.asarray(test_elements).reshape(-1)
    if has_symbols(test_elements) or flat.size > _MOST_TESTED:
        raise UntraceableError("numpy.isin has values to look for that are many or not constant")
    found: Any = np.zeros_like(value, np.bool_)
    for one in flat:
        found = found | (value == one)
    return np.logical_not(found) if invert else found


_MOST_TESTED: Final = 64
"""The most values that ``numpy.isin`` may look for."""


def _putmask(a: Any, mask: Any, values: Any) -> None:
    if np.ndim(values):
        raise UntraceableError("it puts several values where a condition holds")
    _copyto(a, values, where=mask)


def _copyto(dst: Any, src: Any, casting: Any = "same_kind", where: Any = True) -> None:
    graph = graph_of(dst)
    dst[...] = src if where is True else _where(where, as_symbols(graph, src).cast(dst.dtype), dst)


handlers.update(ufunc=call_ufunc, function=call_function)

_OWN: Final[Mapping[Any, Callable[..., Any]]] = {
    **tables.FUNCTIONS,
    **products.FUNCTIONS,
    **sorting.FUNCTIONS,
    **nans.FUNCTIONS,
    np.where: _where,
    np.select: _select,
    np.clip: _clip,
    np.copyto: _copyto,
    np.putmask: _putmask,
    np.argmax: _arg_extreme(np.greater),
    np.argmin: _arg_extreme(np.less),
    np.piecewise: _piecewise,
    np.isin: _isin,
    np.linalg.norm: _norm,
    np.zeros_like: _filled(0),
    np.empty_like: _filled(0),
    np.ones_like: _filled(1),
    np.full_like: full_like,
    np.broadcast_arrays: _broadcast_arrays,
    np.cumsum: _accumulating(np.add),
    np.cumprod: _accumulating(np.multiply),
    np.shape: lambda a: as_symbols(graph_of(a), a).shape,
    np.ndim: lambda a: as_symbols(graph_of(a), a).ndim,
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
    | {np.round, np.around, np.ptp, np.diff, np.polyval, np.isclose}
    | {
        np.sinc,
        np.average,
        getattr(np, "trapezoid", None),
        np.gradient,
        np.append,
        np.angle,
        np.count_nonzero,
    }
    | {np.fix, np.real_if_close}
)
"""Functions that numpy composes of others."""
