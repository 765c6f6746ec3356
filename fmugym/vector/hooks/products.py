"""Products of vectors and matrices: each element is the sum of its products, in their order.

Hooks on arrays compute these products by numpy's linear algebra library, which sums in an order
of its own and rounds less often. So the last bits of the results may differ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from fmugym.expressions.program import UntraceableError
from fmugym.vector.hooks.symbols import LANES, as_symbols, graph_of

__all__ = ["FUNCTIONS", "matmul"]

_MOST_PRODUCTS: Final = 1024
"""The most products of one environment; the linear algebra library is faster with more."""


def _both(a: Any, b: Any) -> list[Any]:
    graph = graph_of(a, b)
    return [as_symbols(graph, one) for one in (a, b)]


def matmul(a: Any, b: Any, **keywords: Any) -> Any:
    """Do what ``numpy.matmul`` does."""
    if any(value is not None for value in keywords.values()):
        raise UntraceableError(f"a product of arrays has the argument {next(iter(keywords))}")
    first, second = _both(a, b)
    if 0 in (first.ndim, second.ndim):
        raise ValueError("matmul does not take single numbers")
    left = first if first.ndim > 1 else first[None]
    right = second if second.ndim > 1 else second[:, None]
    if left.shape[-1] != right.shape[-2]:
        raise ValueError(f"shapes {first.shape} and {second.shape} make no product")
    total = _sum_of(left[..., None] * right[..., None, :, :])
    total = total if first.ndim > 1 else total[..., 0, :]
    return total if second.ndim > 1 else total[..., 0]


def _sum_of(product: Any) -> Any:
    """The sum over the axis before the last one."""
    if product.size > _MOST_PRODUCTS * LANES:
        raise UntraceableError("it multiplies large matrices")
    if product.dtype.kind == "f":
        product.graph.tolerate(product.dtype)
    return np.sum(product, axis=-2, dtype=product.dtype)


def _dot(a: Any, b: Any, out: Any = None) -> Any:
    first, second = _both(a, b)
    if 0 in (first.ndim, second.ndim):
        return first * second
    if max(first.ndim, second.ndim) > 2:
        raise UntraceableError("numpy.dot has arrays of more than two axes")
    return matmul(first, second, out=out)


def _outer(a: Any, b: Any, out: Any = None) -> Any:
    first, second = _both(a, b)
    if out is not None:
        raise UntraceableError("numpy.outer has the argument out")
    return first.ravel()[:, None] * second.ravel()


def _cross(
    a: Any, b: Any, axisa: int = -1, axisb: int = -1, axisc: int = -1, axis: Any = None
) -> Any:
    """The cross product of vectors of three elements."""
    if axis is not None:
        axisa = axisb = axisc = axis
    parts = zip(_both(a, b), (axisa, axisb), strict=True)
    first, second = (np.moveaxis(part, at, 0) for part, at in parts)
    if len(first) != 3 or len(second) != 3:
        raise UntraceableError("numpy.cross has vectors that are not of three elements")
    turns = ((1, 2), (2, 0), (0, 1))
    elements = [first[i] * second[j] - first[j] * second[i] for i, j in turns]
    return np.moveaxis(np.stack(elements), 0, axisc)


FUNCTIONS: Final[Mapping[Any, Callable[..., Any]]] = {
    np.dot: _dot,
    np.inner: lambda a, b: _dot(a, np.transpose(b)),
    np.outer: _outer,
    np.cross: _cross,
}
"""The products among numpy's functions of arrays."""
