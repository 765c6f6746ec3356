"""Numbers and conditions of a task, as nodes of its graph.

The graph is made when a task is loaded: equal nodes stand in it once, and what consists of
constants is computed at once. Its operations are those of programs, see
``fmugym.expressions.program``.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError
from fmugym.expressions.graph import Graph
from fmugym.expressions.program import operation_of
from fmugym.expressions.quantities import QUANTITIES

__all__ = ["Computed", "Value", "where"]

_MOST_NODES: Final = 150_000
"""A forecast of 2000 values with errors that grow and last, normalized, takes some 110,000."""

_DOUBLE: Final = np.dtype(np.float64)
_SINGLE: Final = np.dtype(np.float32)
_INTEGER: Final = np.dtype(np.int64)
_FLAG: Final = np.dtype(np.bool_)


def _operator(ufunc: np.ufunc) -> Callable[[Value, Any], Value]:
    return lambda own, other: own.applied(ufunc, own, other)


def _reflected(ufunc: np.ufunc) -> Callable[[Value, Any], Value]:
    return lambda own, other: own.applied(ufunc, other, own)


class Value:
    """A number or a condition of an environment.

    Operators and functions of numpy, such as ``value + 1`` and ``np.sin(value)``, make new nodes.

    Args:
        graph: Has the node.
        node: The number of the node.

    Raises:
        ConfigError: If there are too many nodes.
    """

    __slots__ = ("graph", "node")

    def __init__(self, graph: Graph, node: int) -> None:
        self.graph, self.node = graph, node
        if len(graph.nodes) > _MOST_NODES:
            raise ConfigError(f"the task has too many terms: it computes more than {_MOST_NODES}")

    @classmethod
    def of(cls, graph: Graph, number: float | bool) -> Value:
        """The node of a constant."""
        return cls(graph, graph.constant(number, _type_of(number)))

    @classmethod
    def read(
        cls, graph: Graph, name: str, *keys: str | int, dtype: npt.DTypeLike | None = None
    ) -> Value:
        """The node of a value that an episode has when it is asked.

        Args:
            graph: Gets the node.
            name: A quantity, see ``QUANTITIES``; or an attribute of what functions are called with.
            keys: Indices, one after the other.
            dtype: The type of the value, by default that of the quantity.
        """
        if dtype is None:
            dtype = QUANTITIES[name].dtype if name in QUANTITIES else _DOUBLE
        return cls(graph, graph.load("row", (name, *keys), dtype))

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the value."""
        return self.graph.nodes[self.node].dtype

    @property
    def is_flag(self) -> bool:
        """Whether it is a condition, not a number."""
        return self.dtype is _FLAG

    @property
    def constant(self) -> float | bool | None:
        """The value if it is a constant."""
        known = self.graph.value(self.node)
        return None if known is None else known.item()

    @property
    def number(self) -> Value:
        """The same as a float64: 0 or 1 for a condition."""
        return self.cast(_DOUBLE)

    def cast(self, dtype: npt.DTypeLike) -> Value:
        """The value in another type."""
        if self.dtype is dtype:
            return self
        return Value(self.graph, self.graph.cast(self.node, np.dtype(dtype)))

    def taken(self, table: Hashable) -> Value:
        """The value in a table of the graph, of which this is the index."""
        return self._looked_up("take", table, self.graph.tables[table].dtype)

    def interpolated(self, table: Hashable) -> Value:
        """The value on the straight lines between points, of which this is the coordinate.

        Args:
            table: A table of the graph: the coordinates, the values there, and those before the
                first point and after the last one.
        """
        return self.cast(_DOUBLE)._looked_up("interpolate", table, _DOUBLE)

    def _looked_up(self, kind: str, table: Hashable, dtype: np.dtype[Any]) -> Value:
        return Value(self.graph, self.graph.compute(kind, table, (self.node,), dtype, None))

    __add__ = __radd__ = _operator(np.add)
    __sub__, __rsub__ = _operator(np.subtract), _reflected(np.subtract)
    __mul__ = __rmul__ = _operator(np.multiply)
    __truediv__, __mod__ = _operator(np.divide), _operator(np.remainder)
    __lt__, __gt__ = _operator(np.less), _operator(np.greater)
    __le__, __ge__ = _operator(np.less_equal), _operator(np.greater_equal)
    # Comparisons make nodes instead of bools, and so there is no hash.
    __eq__, __ne__ = _operator(np.equal), _operator(np.not_equal)  # type: ignore[assignment]
    __and__, __or__ = _operator(np.bitwise_and), _operator(np.bitwise_or)
    __xor__, __rshift__ = _operator(np.bitwise_xor), _operator(np.right_shift)
    __hash__ = None  # type: ignore[assignment]

    def __neg__(self) -> Value:
        return self.applied(np.negative, self)

    def __array_ufunc__(self, ufunc: Any, method: str, *operands: Any, **keywords: Any) -> Any:
        if method != "__call__" or keywords:
            return NotImplemented
        return self.applied(ufunc, *operands)

    def applied(self, ufunc: np.ufunc, *operands: Any) -> Value:
        """The value of a function of numpy, of values and numbers."""
        values = [self.beside(one) for one in operands]
        types, dtype = _loop_of(ufunc, tuple([one.dtype for one in values]))
        cast = [one.cast(wanted) for one, wanted in zip(values, types, strict=True)]
        if ufunc in _MADE_OF:
            return _MADE_OF[ufunc](*cast)
        operands = tuple([one.node for one in cast])
        return Value(self.graph, self.graph.compute("ufunc", ufunc, operands, dtype, ufunc))

    def beside(self, operand: Any) -> Value:
        """A value or a number as a value of the same graph."""
        return operand if isinstance(operand, Value) else Value.of(self.graph, operand)


@functools.cache
def _loop_of(
    ufunc: np.ufunc, dtypes: tuple[np.dtype[Any], ...]
) -> tuple[tuple[np.dtype[Any], ...], np.dtype[Any]]:
    """Types of the operands and of the result that a function uses for operands of some types."""
    if set(dtypes) == {_FLAG} and operation_of(ufunc, "?") is None:
        dtypes = (_INTEGER,) * len(dtypes)
    *types, dtype = ufunc.resolve_dtypes((*dtypes, None))
    return tuple(types), dtype


def _type_of(number: float | bool) -> np.dtype[Any]:
    if isinstance(number, bool | np.bool_):
        return _FLAG
    if isinstance(number, np.float32):
        return _SINGLE
    return _INTEGER if isinstance(number, int | np.integer) else _DOUBLE


def where(condition: Value, first: Value | float, second: Value | float) -> Value:
    """Choose the first number if the condition holds, otherwise the second."""
    graph = condition.graph
    nodes = [condition.beside(one).cast(_DOUBLE).node for one in (first, second)]
    return Value(graph, graph.choose(condition.node, *nodes))


_MADE_OF: Final[Mapping[Any, Callable[[Value], Value]]] = {
    np.square: lambda x: x * x,
    np.radians: lambda x: x * (np.pi / 180.0),
    np.degrees: lambda x: x * (180.0 / np.pi),
    np.sign: lambda x: where(x > 0.0, 1.0, where(x < 0.0, -1.0, x + 0.0)),
}
"""Functions that operations make up, as numpy does."""

Computed = Value | Sequence["Computed"] | Mapping[str, "Computed"]
"""Result of a task's formula: one value, or a list or a dict of values."""
