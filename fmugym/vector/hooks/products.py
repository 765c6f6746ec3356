"""Products of vectors and matrices: each element is the sum of its products, in their order.

Hooks on arrays compute these products by numpy's linear algebra library, which sums in an order
of its own and rounds less often. So the last bits of the results may differ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from fmugym.vector.hooks.graph import Graph
from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.symbols import LANES, Symbols, as_symbols, graph_of

__all__ = ["FUNCTIONS", "UFUNCS"]

_MOST_PRODUCTS: Final = 1024
"""The most products of one environment; the linear algebra library is faster with more."""

Labels = tuple[Any, ...]
"""A name for each axis. An axis with the same name in two arrays is the same."""


def contracted(arrays: Sequence[Any], labels: Sequence[Labels], wanted: Labels) -> Symbols:
    """Multiply arrays, and sum over the axes whose names are not wanted in the result.

    Raises:
        UntraceableError: If there are too many products, or an array has two axes of one name.
    """
    graph = graph_of(*arrays)
    parts = [as_symbols(graph, array) for array in arrays]
    names = [name for one in labels for name in one]
    summed = list(dict.fromkeys(name for name in names if name not in wanted))
    order = [*wanted, *summed]
    aligned = [_aligned(part, one, order) for part, one in zip(parts, labels, strict=True)]
    product: Any = aligned[0]
    for part in aligned[1:]:
        product = product * part
    if not summed:
        return product  # type: ignore[no-any-return]  # numpy's stubs
    return _sum_of(graph, product, len(wanted))


def _aligned(part: Symbols, labels: Labels, order: Sequence[Any]) -> Symbols:
    """An array with its axes in this order, and an axis of one element for each missing name."""
    if len(set(labels)) != len(labels) or part.ndim != len(labels):
        raise UntraceableError("a product of arrays has axes that cannot be followed")
    shape = dict(zip(labels, part.shape, strict=True))
    axes = [labels.index(name) for name in order if name in shape]
    cells = part.cells.transpose(axes).reshape([shape.get(name, 1) for name in order])
    return part.like(cells)


def _sum_of(graph: Graph, product: Symbols, kept: int) -> Symbols:
    """The sum over the last axes, from the first term on."""
    terms = np.moveaxis(product.cells.reshape(*product.shape[:kept], -1), -1, 0)
    if product.size > _MOST_PRODUCTS * LANES:
        raise UntraceableError("it multiplies large matrices")
    if product.dtype.kind == "f" and len(terms) > 1:
        graph.is_inexact = True
    if not len(terms):
        return product.like(np.zeros(terms.shape[1:])).cast(product.dtype)
    total: Any = product.like(terms[0])
    for term in terms[1:]:
        total = total + product.like(term)
    return total  # type: ignore[no-any-return]  # numpy's stubs


def _others(name: str, count: int) -> Labels:
    return tuple((name, index) for index in range(count))


def _stack(count: int) -> Labels:
    """Names of axes that are counted from the last one."""
    return tuple(("stack", -index) for index in range(count, 0, -1))


def _common(*labels: Labels) -> Labels:
    return max(labels, key=len)


def _ndims(*arrays: Any) -> list[int]:
    graph = graph_of(*arrays)
    return [as_symbols(graph, array).ndim for array in arrays]


def _in_stacks(first: Labels, second: Labels, result: Labels) -> Callable[..., Symbols]:
    """A product of the last axes; those before them are the axes of a stack of arrays."""

    def multiply(a: Any, b: Any) -> Symbols:
        counts = _ndims(a, b)
        outer = [_stack(n - len(own)) for n, own in zip(counts, (first, second), strict=True)]
        named = (*outer[0], *first), (*outer[1], *second)
        return contracted((a, b), named, (*_common(*outer), *result))

    return multiply


_vecdot = _in_stacks(("k",), ("k",), ())
_matvec = _in_stacks(("i", "k"), ("k",), ("i",))
_vecmat = _in_stacks(("k",), ("k", "j"), ("j",))
_of_matrices = _in_stacks(("i", "k"), ("k", "j"), ("i", "j"))


def _matmul(a: Any, b: Any, **keywords: Any) -> Symbols:
    _refuse(keywords)
    match _ndims(a, b):
        case [0, _] | [_, 0]:
            raise ValueError("matmul does not take single numbers")
        case [1, 1]:
            return _vecdot(a, b)
        case [1, _]:
            return _vecmat(a, b)
        case [_, 1]:
            return _matvec(a, b)
    return _of_matrices(a, b)


def _vector_dot(x1: Any, x2: Any, axis: int = -1, **keywords: Any) -> Symbols:
    _refuse(keywords)
    graph = graph_of(x1, x2)
    parts = [as_symbols(graph, part) for part in (x1, x2)]
    return _vecdot(*(part.like(np.moveaxis(part.cells, axis, -1)) for part in parts))


def _refuse(keywords: Mapping[str, Any]) -> None:
    if any(value is not None for value in keywords.values()):
        raise UntraceableError(f"a product of arrays has the argument {next(iter(keywords))}")


def _dot(a: Any, b: Any, out: Any = None) -> Symbols:
    _refuse({"out": out})
    first, second = _ndims(a, b)
    if first == 0 or second == 0:
        return a * b  # type: ignore[no-any-return]  # numpy's stubs
    of_a, of_b = _others("a", first - 1), _others("b", second - 1)
    before_last = second - 2 if second > 1 else 0
    named = (*of_b[:before_last], "k", *of_b[before_last:])
    return contracted((a, b), ((*of_a, "k"), named), (*of_a, *of_b))


def _inner(a: Any, b: Any) -> Symbols:
    first, second = _ndims(a, b)
    if first == 0 or second == 0:
        return a * b  # type: ignore[no-any-return]  # numpy's stubs
    of_a, of_b = _others("a", first - 1), _others("b", second - 1)
    return contracted((a, b), ((*of_a, "k"), (*of_b, "k")), (*of_a, *of_b))


def _outer(a: Any, b: Any, out: Any = None) -> Symbols:
    _refuse({"out": out})
    graph = graph_of(a, b)
    flat = [as_symbols(graph, part).ravel() for part in (a, b)]
    return contracted(flat, (("i",), ("j",)), ("i", "j"))


def _tensordot(a: Any, b: Any, axes: Any = 2) -> Symbols:
    first, second = _ndims(a, b)
    if isinstance(axes, int):
        axes = range(first - axes, first), range(axes)
    pairs = [np.atleast_1d(np.array(list(one) if np.iterable(one) else one)) for one in axes]
    places = [[int(i) % n for i in one] for one, n in zip(pairs, (first, second), strict=True)]
    named = [list(_others("a", first)), list(_others("b", second))]
    for number, (i, j) in enumerate(zip(*places, strict=True)):
        named[0][i] = named[1][j] = ("k", number)
    wanted = [name for one in named for name in one if name[0] != "k"]
    return contracted((a, b), (tuple(named[0]), tuple(named[1])), tuple(wanted))


def _einsum(subscripts: Any, *operands: Any, out: Any = None, **keywords: Any) -> Symbols:
    keywords.pop("optimize", None)
    _refuse({"out": out, **keywords})
    if not isinstance(subscripts, str):
        raise UntraceableError("numpy.einsum has no text of subscripts")
    given, arrow, wanted = subscripts.replace(" ", "").partition("->")
    texts = given.split(",")
    labels = [_labels(text, n) for text, n in zip(texts, _ndims(*operands), strict=True)]
    stack = _common(*(tuple(n for n in one if isinstance(n, tuple)) for one in labels))
    if not arrow:
        letters = given.replace(",", "").replace(".", "")
        wanted = "..." + "".join(sorted(one for one in set(letters) if letters.count(one) == 1))
    return contracted(operands, labels, _labels(wanted, len(wanted.replace(".", "")), stack))


def _labels(text: str, ndim: int, stack: Labels | None = None) -> Labels:
    """The names of the axes in a part of the subscripts of ``numpy.einsum``."""
    before, dots, after = text.partition("...")
    missing = ndim - len(before) - len(after)
    inner = (_stack(missing) if stack is None else stack) if dots else ()
    return (*before, *inner, *after)


def _cross(
    a: Any, b: Any, axisa: int = -1, axisb: int = -1, axisc: int = -1, axis: Any = None
) -> Any:
    """The cross product of vectors of three elements."""
    if axis is not None:
        axisa = axisb = axisc = axis
    graph = graph_of(a, b)
    parts = [as_symbols(graph, part) for part in (a, b)]
    first, second = (np.moveaxis(p, at, 0) for p, at in zip(parts, (axisa, axisb), strict=True))
    if len(first) != 3 or len(second) != 3:
        raise UntraceableError("numpy.cross has vectors that are not of three elements")
    turns = ((1, 2), (2, 0), (0, 1))
    elements = [first[i] * second[j] - first[j] * second[i] for i, j in turns]
    return np.moveaxis(np.stack(elements), 0, axisc)


def _those_of(module: Any, functions: Mapping[str, Callable[..., Symbols]]) -> dict[Any, Any]:
    """Functions by those of numpy that they stand for; older releases do not have all of them."""
    known = {getattr(module, name, None): own for name, own in functions.items()}
    known.pop(None, None)
    return known


UFUNCS: Final[Mapping[Any, Callable[..., Symbols]]] = _those_of(
    np, {"matmul": _matmul, "vecdot": _vector_dot, "matvec": _matvec, "vecmat": _vecmat}
)
"""The products that numpy has as element-wise functions of whole vectors and matrices."""

FUNCTIONS: Final[Mapping[Any, Callable[..., Symbols]]] = {
    np.dot: _dot,
    np.inner: _inner,
    np.outer: _outer,
    np.tensordot: _tensordot,
    np.einsum: _einsum,
    np.cross: _cross,
    **_those_of(np.linalg, {"matmul": _matmul, "vecdot": _vector_dot, "tensordot": _tensordot}),
}
"""The products among numpy's functions of arrays."""
