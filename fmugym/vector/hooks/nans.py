"""numpy's functions that leave NaNs out, for symbolic arrays of a few elements."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.sorting import kept_or_not, middle_of, rows_of, sorted_rows
from fmugym.vector.hooks.symbols import Symbols, as_symbols, graph_of

__all__ = ["FUNCTIONS"]


def _values(a: Any) -> Symbols:
    return as_symbols(graph_of(a), a)


def _refuse(function: Any, arguments: Mapping[str, Any]) -> None:
    """Refuse the arguments that are rarely used."""
    for name, value in arguments.items():
        if value is not None and value is not np._NoValue:
            raise UntraceableError(f"it uses the argument {name} of numpy.{function.__name__}")


def _without(values: Symbols, number: Any) -> Any:
    """The values with a number in the place of each NaN."""
    return np.where(np.isnan(values), values.dtype.type(number), values)


def _reducing(function: Any, of_numbers: Any, number: Any) -> Callable[..., Any]:
    """A function that is another one once a number has taken the place of each NaN."""

    def reduce(
        a: Any,
        axis: Any = None,
        dtype: Any = None,
        out: Any = None,
        keepdims: Any = False,
        **kw: Any,
    ) -> Any:
        _refuse(function, {"out": out, **kw})
        values = _values(a)
        if values.dtype.kind == "f":
            values = _without(values, number)
        arguments = {} if "cum" in function.__name__ else {"keepdims": keepdims is True}
        return of_numbers(values, axis=axis, dtype=dtype, **arguments)

    return reduce


def _extreme(function: Any, of_numbers: Any) -> Callable[..., Any]:
    def reduce(a: Any, axis: Any = None, out: Any = None, keepdims: Any = False, **kw: Any) -> Any:
        _refuse(function, {"out": out, **kw})
        return of_numbers.reduce(_values(a), axis=axis, keepdims=keepdims is True)

    return reduce


def _count(values: Symbols, axis: Any, keepdims: bool) -> Any:
    return np.sum(np.logical_not(np.isnan(values)), axis=axis, dtype=np.intp, keepdims=keepdims)


def _divided(total: Any, count: Any) -> Any:
    """The quotient in the type of the total."""
    return (total / count).astype(total.dtype)


def _nanmean(
    a: Any, axis: Any = None, dtype: Any = None, out: Any = None, keepdims: Any = False, **kw: Any
) -> Any:
    _refuse(np.nanmean, {"out": out, **kw})
    values, keeps = _values(a), keepdims is True
    if values.dtype.kind != "f":
        return np.mean(values, axis=axis, dtype=dtype, keepdims=keeps)
    total = np.sum(_without(values, 0), axis=axis, dtype=dtype, keepdims=keeps)
    return _divided(total, _count(values, axis, keeps))


def _nanvar(
    a: Any,
    axis: Any = None,
    dtype: Any = None,
    out: Any = None,
    ddof: Any = 0,
    keepdims: Any = False,
    **kw: Any,
) -> Any:
    _refuse(np.nanvar, {"out": out, **kw})
    values, keeps = _values(a), keepdims is True
    if values.dtype.kind != "f":
        return np.var(values, axis=axis, dtype=dtype, ddof=ddof, keepdims=keeps)
    numbers = _without(values, 0)
    total: Any = np.sum(numbers, axis=axis, dtype=dtype, keepdims=True)
    mean = _divided(total, _count(values, axis, True))
    distances = _of_numbers((numbers - mean).astype(values.dtype), values)
    total = np.sum(distances * distances, axis=axis, dtype=dtype, keepdims=keeps)
    freedom = _count(values, axis, keeps) - ddof
    return np.where(freedom <= 0, total.dtype.type(np.nan), _divided(total, freedom))


def _of_numbers(distances: Any, values: Symbols) -> Any:
    return np.where(np.isnan(values), values.dtype.type(0), distances)


def _nanstd(*args: Any, **keywords: Any) -> Any:
    return np.sqrt(_nanvar(*args, **keywords))


def _nanmedian(
    a: Any, axis: Any = None, out: Any = None, overwrite_input: Any = False, keepdims: Any = False
) -> Any:
    """The median of the first numbers in sorted order; NaNs are behind them."""
    _refuse(np.nanmedian, {"out": out})
    values = _values(a)
    if values.dtype.kind != "f":
        return np.median(values, axis=axis, keepdims=keepdims is True)
    if values.dtype == np.float16:  # numpy rounds it differently with and without an axis
        raise UntraceableError("it uses numpy.nanmedian of float16")
    rows = sorted_rows(rows_of(values, axis))
    count = sum(np.logical_not(np.isnan(row)).astype(np.intp) for row in rows)
    result = rows[-1]  # NaN, if all are
    for number in range(1, len(rows) + 1):
        result = np.where(count == number, middle_of(rows[:number]), result)
    return kept_or_not(result, values, axis, keepdims)


def _nan_to_num(
    x: Any, copy: bool = True, nan: Any = 0.0, posinf: Any = None, neginf: Any = None
) -> Any:
    value: Any = _values(x)
    if value.dtype.kind != "f":
        return value.copy()
    limits: Any = np.finfo(value.dtype)
    high = limits.max if posinf is None else posinf
    low = limits.min if neginf is None else neginf
    for condition, number in (
        (np.isnan(value), nan),
        (value == np.inf, high),
        (value == -np.inf, low),
    ):
        part = as_symbols(value.graph, number).cast(value.dtype)
        value = np.where(condition, part, value)
    return value


FUNCTIONS: Final[Mapping[Any, Callable[..., Any]]] = {
    np.nansum: _reducing(np.nansum, np.sum, 0),
    np.nanprod: _reducing(np.nanprod, np.prod, 1),
    np.nancumsum: _reducing(np.nancumsum, np.cumsum, 0),
    np.nancumprod: _reducing(np.nancumprod, np.cumprod, 1),
    np.nanmin: _extreme(np.nanmin, np.fmin),
    np.nanmax: _extreme(np.nanmax, np.fmax),
    np.nanmean: _nanmean,
    np.nanvar: _nanvar,
    np.nanstd: _nanstd,
    np.nanmedian: _nanmedian,
    np.nan_to_num: _nan_to_num,
}
"""The functions of numpy that leave NaNs out."""
