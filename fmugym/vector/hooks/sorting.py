"""numpy's sorting functions for symbolic arrays of a few elements: sorts, medians, quantiles.

A program sorts by comparing and exchanging pairs in a fixed order. Equal elements keep their
order, and NaNs go to the end. numpy gives the same values. Where elements are equal but differ,
which only zeros of different sign do, numpy's order depends on the processor.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.symbols import Symbols, as_symbols, graph_of, has_symbols

__all__ = ["FUNCTIONS", "kept_or_not", "middle_of", "rows_of", "sorted_rows"]

_MOST_SORTED: Final = 32
"""The most elements that a program sorts: it compares nearly all pairs of them."""


def rows_of(values: Symbols, axis: Any) -> list[Any]:
    """The elements along an axis, or all elements if there is no axis.

    Raises:
        UntraceableError: If there are several axes or many elements.
    """
    if np.ndim(axis) != 0:
        raise UntraceableError("it sorts along several axes")
    cells = values.cells.ravel() if axis is None else np.moveaxis(values.cells, axis, 0)
    if len(cells) > _MOST_SORTED:
        raise UntraceableError(f"it sorts more than {_MOST_SORTED} elements")
    return [values.like(row) for row in cells]


def sorted_rows(rows: list[Any]) -> list[Any]:
    """Sort elements, each of which is an array of values for other places."""
    return [row for row, _ in _sorted_pairs([(row, None) for row in rows])]


def _sorted_pairs(pairs: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    """Sort elements and what belongs to them by insertion, as a program without branches."""
    pairs = list(pairs)
    for end in range(1, len(pairs)):
        for place in range(end, 0, -1):
            pairs[place - 1 : place + 1] = _exchanged(*pairs[place - 1 : place + 1])
    return pairs


def _exchanged(first: tuple[Any, Any], second: tuple[Any, Any]) -> list[tuple[Any, Any]]:
    a, b = first[0], second[0]
    is_later = np.logical_not(a <= b)
    if a.dtype.kind == "f":
        is_later &= b == b
    low, high = np.where(is_later, b, a), np.where(is_later, a, b)
    if first[1] is None:
        return [(low, None), (high, None)]
    marks = first[1], second[1]
    return [
        (low, np.where(is_later, marks[1], marks[0])),
        (high, np.where(is_later, marks[0], marks[1])),
    ]


def _stacked(rows: list[Any], axis: Any) -> Any:
    return np.stack(rows, axis=0 if axis is None else axis)


def _sort(
    a: Any, axis: Any = -1, kind: Any = None, order: Any = None, *, stable: Any = None
) -> Any:
    values = as_symbols(graph_of(a), a)
    return _stacked(sorted_rows(rows_of(values, axis)), axis)


def _argsort(
    a: Any, axis: Any = -1, kind: Any = None, order: Any = None, *, stable: Any = None
) -> Any:
    values = as_symbols(graph_of(a), a)
    rows = rows_of(values, axis)
    if kind not in ("stable", "mergesort") and not stable:
        _require_stable(len(rows), values.dtype)
    numbers = [np.full_like(row, number, np.intp) for number, row in enumerate(rows)]
    pairs = _sorted_pairs(list(zip(rows, numbers, strict=True)))
    return _stacked([number for _, number in pairs], axis)


def _require_stable(count: int, dtype: np.dtype[Any]) -> None:
    if not sorts_stably(count, dtype.char):
        raise UntraceableError(
            "it uses numpy.argsort, whose order of equal elements depends on the processor: "
            'use kind="stable"'
        )


@functools.cache
def sorts_stably(count: int, letter: str) -> bool:
    """Whether numpy's ``argsort`` of a few elements leaves equal ones in their order here."""
    if count > _MOST_TRIED:
        return False
    tied = np.array(list(itertools.product(range(min(count, 3)), repeat=count)), letter)
    return np.array_equal(np.argsort(tied), np.argsort(tied, kind="stable"))


_MOST_TRIED: Final = 8


# Medians and quantiles


def middle_of(rows: list[Any]) -> Any:
    """The mean of the one or two elements in the middle of sorted ones."""
    half = len(rows) // 2
    return np.mean(
        np.stack(rows[half : half + 1] if len(rows) % 2 else rows[half - 1 : half + 1]), 0
    )


def kept_or_not(result: Any, values: Symbols, axis: Any, keepdims: Any) -> Any:
    """The result, with an axis of length one in the place of each reduced axis if wanted."""
    if keepdims is not True:
        return result
    if axis is None:
        return np.reshape(result, (1,) * values.ndim)
    return np.expand_dims(result, axis)


def _or_nan(result: Any, last: Any) -> Any:
    """NaN where the last one of sorted elements is NaN."""
    if last.dtype.kind != "f":
        return result
    return np.where(np.isnan(last), result.dtype.type(np.nan), result)


def _median(
    a: Any, axis: Any = None, out: Any = None, overwrite_input: Any = False, keepdims: Any = False
) -> Any:
    if out is not None:
        raise UntraceableError("it uses the argument out of numpy.median")
    values = as_symbols(graph_of(a), a)
    rows = sorted_rows(rows_of(values, axis))
    return kept_or_not(_or_nan(middle_of(rows), rows[-1]), values, axis, keepdims)


def _percentile(a: Any, q: Any, *args: Any, **keywords: Any) -> Any:
    _require_constant(q)
    is_number = type(q) in (int, float)
    return _quantile(a, q / 100 if is_number else np.true_divide(q, 100), *args, **keywords)


def _require_constant(q: Any) -> None:
    if has_symbols(q):
        raise UntraceableError("it computes a quantile that is not constant")


def _quantile(
    a: Any,
    q: Any,
    axis: Any = None,
    out: Any = None,
    overwrite_input: Any = False,
    method: str = "linear",
    keepdims: Any = False,
    *,
    weights: Any = None,
) -> Any:
    _require_constant(q)
    if out is not None or weights is not None:
        raise UntraceableError("it uses the argument out or weights of numpy.quantile")
    values = as_symbols(graph_of(a), a)
    rows = sorted_rows(rows_of(values, axis))
    sample: Any = np.repeat(values.dtype.type(0), len(rows))
    dtype = np.quantile(sample, q, method=method).dtype  # type: ignore[call-overload]  # one of numpy's names

    def one(number: float) -> Any:
        result = _between(rows, number, method, dtype)
        return kept_or_not(_or_nan(result, rows[-1]), values, axis, keepdims)

    if np.ndim(q) == 0:
        return one(float(q))
    return np.stack([one(number) for number in np.ravel(q)]).reshape(
        (*np.shape(q), *one(0.0).shape)
    )


def _between(rows: list[Any], quantile: float, method: str, dtype: np.dtype[Any]) -> Any:
    """The quantile of sorted elements, by one of numpy's methods."""
    place = (len(rows) - 1) * quantile
    if method in _PLACES:
        return rows[_PLACES[method](place)].astype(dtype)
    if method == "midpoint":
        place = 0.5 * (math.floor(place) + math.ceil(place))
    elif method != "linear":
        raise UntraceableError(f"it uses the method {method!r} of numpy.quantile")
    before = math.floor(place) if place < len(rows) - 1 else len(rows) - 1
    after = min(before + 1, len(rows) - 1)
    return _interpolated(rows[before], rows[after], place - math.floor(place), dtype)


_PLACES: Final[Mapping[str, Callable[[float], int]]] = {
    "lower": math.floor,
    "higher": math.ceil,
    "nearest": round,
}
"""The methods that choose one of the elements: the nearest even one if two are as near."""


def _interpolated(a: Any, b: Any, weight: float, dtype: np.dtype[Any]) -> Any:
    """Interpolate as numpy does, from the side that is nearer."""
    part: Any = weight if dtype == a.dtype else np.float64(weight)
    difference = b - a
    if weight >= 0.5:
        return b - difference * (1 - part)
    return a + difference * part


FUNCTIONS: Final[Mapping[Any, Callable[..., Any]]] = {
    np.sort: _sort,
    np.argsort: _argsort,
    np.median: _median,
    np.quantile: _quantile,
    np.percentile: _percentile,
}
"""The functions of numpy that sort."""
