"""What a task computes: numbers and conditions, as nodes of a graph.

The graph has the nodes that hooks are compiled to, see ``fmugym.vector.hooks.graph``: equal ones
once, and what consists of constants is computed at once. It is made when a task is loaded. From it
come the functions that an environment calls.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial, reduce
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.declared.mathematics import (
    chosen,
    divide,
    float32,
    float64,
    interpolated,
    looked_up,
    remainder,
    square,
)
from fmugym.errors import ConfigError
from fmugym.vector.hooks.graph import Cell, Graph, Node
from fmugym.vector.hooks.lowering import registers_of

__all__ = ["Computed", "Value", "function_of", "where"]

_MOST_NODES: Final = 50_000
"""A forecast of 2000 values with errors that grow and last, normalized, takes some 32,000."""

_DOUBLE: Final = np.dtype(np.float64)


def _operator(ufunc: np.ufunc) -> Callable[[Value, Any], Value]:
    def apply(own: Value, other: Any) -> Value:
        value: Value = ufunc(own, other)
        return value

    return apply


class Value:
    """A number or a condition of an environment.

    Operators and functions of numpy, such as ``value + 1`` and ``np.sin(value)``, make new nodes.

    Args:
        graph: Has the node.
        cell: Refers to it.
    """

    __slots__ = ("cell", "graph")

    def __init__(self, graph: Graph, cell: Cell) -> None:
        self.graph, self.cell = graph, cell

    @classmethod
    def of(cls, graph: Graph, number: float | bool) -> Value:
        """The node of a constant."""
        return cls(graph, graph.constant(number, _type_of(number)))

    @classmethod
    def read(
        cls, graph: Graph, attribute: str, *keys: str | int, dtype: npt.DTypeLike = _DOUBLE
    ) -> Value:
        """The node of a value that an environment has when it is asked.

        Args:
            graph: Gets the node.
            attribute: The attribute of the environment.
            keys: What to index it with, one key after the other.
            dtype: The type of the value.
        """
        return cls(graph, graph.load("row", (attribute, *keys), dtype, None))

    @property
    def node(self) -> int:
        """The number of the node."""
        return self.cell.node

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type of the value."""
        return self.graph.node(self.cell).dtype

    @property
    def is_flag(self) -> bool:
        """Whether it is a condition, not a number."""
        return self.dtype == np.bool_

    @property
    def constant(self) -> float | bool | None:
        """The value if it is a constant."""
        known = self.graph.value(self.cell)
        return None if known is None else known.item()

    @property
    def number(self) -> Value:
        """The same as a number: 0 or 1 for a condition."""
        return self * 1.0 if self.is_flag else self

    def cast(self, dtype: npt.DTypeLike) -> Value:
        """The value in another type of floats."""
        return Value(self.graph, self.graph.cast(self.cell, np.dtype(dtype)))

    def taken(self, table: Hashable) -> Value:
        """The value in a table of the graph, of which this is the index."""
        return self.computed("take", table, (self,), self.graph.tables[table].dtype)

    def interpolated(self, table: Hashable) -> Value:
        """The value on the straight lines between points, of which this is the coordinate.

        Args:
            table: A table of the graph: the coordinates, the values there, and those before the
                first point and after the last one.
        """
        return self.computed("interpolate", table, (self,), _DOUBLE)

    def called(self, function: Callable[..., Any], *others: Any) -> Value:
        """The number that a function of Python returns of this value and others."""
        return self.computed("function", function, (self, *others), _DOUBLE)

    def computed(
        self,
        kind: str,
        what: Hashable,
        operands: tuple[Any, ...],
        dtype: np.dtype[Any],
        fold: Callable[..., Any] | None = None,
    ) -> Value:
        """A node of this graph; see ``Graph.compute``.

        Args:
            kind: What it does.
            what: With what.
            operands: Values and numbers.
            dtype: The type of its value.
            fold: Computes it of constants; None for what is always read from an environment.

        Raises:
            ConfigError: If there are too many.
        """
        cells = tuple(self._beside(one).cell for one in operands)
        cell = self.graph.compute(kind, what, cells, dtype, fold)
        if len(self.graph.nodes) > _MOST_NODES:
            raise ConfigError(f"the task has too many terms: it computes more than {_MOST_NODES}")
        return Value(self.graph, cell)

    __add__ = __radd__ = _operator(np.add)
    __sub__, __mod__ = _operator(np.subtract), _operator(np.remainder)
    __mul__ = __rmul__ = _operator(np.multiply)
    __truediv__ = _operator(np.divide)
    __lt__, __gt__ = _operator(np.less), _operator(np.greater)
    # Comparisons make nodes instead of bools, and so there is no hash.
    __eq__, __ne__ = _operator(np.equal), _operator(np.not_equal)  # type: ignore[assignment]
    __and__, __or__ = _operator(np.bitwise_and), _operator(np.bitwise_or)
    __xor__ = _operator(np.bitwise_xor)
    __hash__ = None  # type: ignore[assignment]

    def __array_ufunc__(self, ufunc: Any, method: str, *operands: Any, **keywords: Any) -> Any:
        if method != "__call__" or keywords:
            return NotImplemented
        values = tuple(map(self._beside, operands))
        dtype = ufunc.resolve_dtypes((*(value.dtype for value in values), None))[-1]
        return self.computed("ufunc", ufunc, values, dtype, ufunc)

    def _beside(self, operand: Any) -> Value:
        return operand if isinstance(operand, Value) else Value.of(self.graph, operand)


def _type_of(number: float | bool) -> np.dtype[Any]:
    if isinstance(number, bool | np.bool_):
        return np.dtype(np.bool_)
    return np.dtype(np.int64) if isinstance(number, int | np.integer) else _DOUBLE


def where(condition: Value, first: Value | float, second: Value | float) -> Value:
    """The first number where a condition holds, otherwise the second."""
    return condition.computed("where", None, (condition, first, second), _DOUBLE, np.where)


Computed = Value | Sequence["Computed"] | Mapping[str, "Computed"]
"""What a function returns: one value, or a list or a dict of them."""


_OF_PYTHON: Final[Mapping[Any, Callable[..., Any]]] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
    np.negative: operator.neg,
    np.absolute: abs,
    np.less: operator.lt,
    np.less_equal: operator.le,
    np.greater: operator.gt,
    np.greater_equal: operator.ge,
    np.equal: operator.eq,
    np.not_equal: operator.ne,
    np.bitwise_and: operator.and_,
    np.bitwise_or: operator.or_,
    np.bitwise_xor: operator.xor,
    np.divide: divide,
    np.remainder: remainder,
    np.square: square,
}
"""What takes the place of functions of numpy: on single numbers, it takes far less time."""


def function_of(result: Computed) -> Callable[[Any], Any]:
    """Make a function of the environment that returns values, lists of them as tuples.

    It serves one environment, arrays of them, and the trace that compiles hooks. A value that is
    needed several times is computed once.
    """
    values: list[Value] = []
    _each(values.append, result)
    graph = values[0].graph if values else Graph()
    results = [value.node for value in values]
    order = graph.needed(results)
    constants = [number for number in order if graph.nodes[number].kind == "constant"]
    computed = [(n, graph.nodes[n]) for n in order if graph.nodes[n].kind != "constant"]
    places = registers_of([(n, node.operands) for n, node in computed], constants, results)
    known = [graph.nodes[number].number.item() for number in constants]
    known += [None] * (1 + max(places.values(), default=-1) - len(known))
    steps = [
        (places[n], _operation(graph, node), [places[one] for one in node.operands] or [-1])
        for n, node in computed
    ]
    form = _each(lambda value: places[value.node], result)

    def evaluate(env: Any) -> Any:
        registers = [*known, env]
        find = registers.__getitem__
        with np.errstate(all="ignore"):  # a result that is not finite is a fault of the episode
            for place, operation, operands in steps:
                registers[place] = operation(*map(find, operands))
        return _each(find, form)

    return evaluate


def _each(function: Callable[[Any], Any], parts: Any) -> Any:
    """Apply a function to each part of a result."""
    if isinstance(parts, dict):
        return {name: _each(function, part) for name, part in parts.items()}
    if isinstance(parts, list | tuple):
        return tuple([_each(function, part) for part in parts])
    return function(parts)


def _operation(graph: Graph, node: Node) -> Callable[..., Any]:
    """The function of Python for a node: of its operands, or of the environment."""
    what: Any = node.what
    match node.kind:
        case "row":
            attribute, *keys = what
            read = operator.attrgetter(attribute)
            return lambda env: reduce(operator.getitem, keys, read(env))
        case "ufunc":
            return _OF_PYTHON.get(what, what)
        case "cast":
            return float32 if node.dtype == np.float32 else float64
        case "where":
            return chosen
        case "take":
            return partial(looked_up, graph.tables[what])
        case "interpolate":
            return partial(interpolated, graph.tables, what)
    function: Callable[..., Any] = what
    return function
