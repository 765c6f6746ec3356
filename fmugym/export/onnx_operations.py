"""The operations of graphs as nodes of ONNX.

Where ONNX Runtime has a function in float32 only, or not at all, it is composed of others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Mapping
from typing import Any, Final

import numpy as np

from fmugym.errors import ConfigError
from fmugym.export.onnx_nodes import Nodes
from fmugym.expressions.graph import Graph, Node
from fmugym.expressions.program import letter_of, operation_of
from fmugym.expressions.value import Value, where

__all__ = ["Operations"]

_SAME: Final[Mapping[str, str]] = {
    **{
        name: name.capitalize()
        for name in (
            *("add", "less", "equal", "greater", "and", "or", "xor", "not"),
            *("sqrt", "exp", "log", "sin", "cos", "tanh", "floor", "ceil"),
        )
    },
    "subtract": "Sub",
    "multiply": "Mul",
    "divide": "Div",
    "less_equal": "LessOrEqual",
    "greater_equal": "GreaterOrEqual",
    "minimum": "Min",
    "maximum": "Max",
    "power": "Pow",
    "absolute": "Abs",
    "negative": "Neg",
    "rint": "Round",
}
"""Operations that ONNX has, for the same types of operands."""

_ANGLES: Final[Mapping[str, str]] = {"arcsin": "Asin", "arccos": "Acos", "arctan": "Atan"}
"""Functions that ONNX Runtime computes with float32 only."""


def _remainder(a: Any, b: Any) -> Any:
    """The remainder with the sign of the divisor."""
    rest = np.fmod(a, b)
    return where((rest != 0.0) & ((rest < 0.0) != (b < 0.0)), rest + b, rest)


def _arctan2(y: Any, x: Any) -> Any:
    """2 atan(y / (r + x)), and pi on the negative axis."""
    length = np.hypot(x, y)
    below = length + x
    is_axis = below == 0.0
    angle = 2.0 * np.arctan(y / where(is_axis, 1.0, below))
    return where(is_axis, where(length == 0.0, 0.0, math.pi), angle)


_COMPOSED: Final[Mapping[str, Callable[..., Any]]] = {
    "not_equal": lambda a, b: (a == b) ^ True,
    "remainder": _remainder,
    "floor_divide": lambda a, b: np.rint((a - np.remainder(a, b)) / b),
    "hypot": lambda a, b: np.sqrt(a * a + b * b),
    "arctan2": _arctan2,
    "tan": lambda x: np.sin(x) / np.cos(x),
    "sinh": lambda x: 0.5 * (np.exp(x) - np.exp(-x)),
    "cosh": lambda x: 0.5 * (np.exp(x) + np.exp(-x)),
    "arcsinh": lambda x: np.log(x + np.sqrt(x * x + 1.0)),
    "arccosh": lambda x: np.log(x + np.sqrt(x * x - 1.0)),
    "arctanh": lambda x: 0.5 * np.log((1.0 + x) / (1.0 - x)),
    "log1p": lambda x: np.log(x + 1.0),
    "log2": lambda x: np.log(x) * (1 / math.log(2)),
    "log10": lambda x: np.log(x) * (1 / math.log(10)),
    "expm1": lambda x: np.exp(x) - 1.0,
    "exp2": lambda x: np.power(2.0, x),
}
"""Functions of values, by others that ONNX has."""


class Operations:
    """Writes the operations of a graph as nodes of ONNX.

    Args:
        nodes: Takes the nodes.
        graph: The operations. Those that make up others are added.
        loads: The numbers of those that the model finds.
        load: Returns the name of such a value.
    """

    def __init__(
        self, nodes: Nodes, graph: Graph, loads: Container[int], load: Callable[[int], str]
    ) -> None:
        self._nodes, self._graph, self._loads, self._load = nodes, graph, loads, load
        self._names: dict[int, str] = {}

    def written(self, numbers: Iterable[int]) -> list[str]:
        """Write operations, and the ones that they need; returns the names of their results.

        Raises:
            ConfigError: If one cannot be written.
        """
        numbers = list(numbers)
        for number in self._graph.needed(numbers, self._loads):
            if number not in self._names:
                is_load = number in self._loads
                name = self._load(number) if is_load else self._write(self._graph.nodes[number])
                self._names[number] = name
        return [self._names[number] for number in numbers]

    def _write(self, node: Node) -> str:
        operands, what, nodes = [self._names[one] for one in node.operands], node.what, self._nodes
        match node.kind:
            case "constant":
                return nodes.constant(node.number, node.dtype)
            case "ufunc":
                return self._function(what, node.operands)
            case "cast":
                return nodes.cast(operands[0], node.dtype)
            case "where":
                return nodes.add("Where", *operands)
            case "take":
                return nodes.add("Gather", nodes.tensor(self._graph.tables[what]), *operands)
        return self._interpolated(node.operands[0], self._graph.tables[what])

    def _function(self, ufunc: Any, numbers: Iterable[int]) -> str:
        add, operands = self._nodes.add, [self._names[number] for number in numbers]
        values = list(map(self._value, numbers))
        dtype = values[0].dtype
        operation = str(operation_of(ufunc, letter_of(dtype)))
        match operation:
            case "fmod d":
                return add("Mod", *operands, fmod=1)
            case "remainder q":
                return add("Mod", *operands)
            case "floor_divide q":
                rest = add("Mod", *operands)
                return add("Div", add("Sub", operands[0], rest), operands[1])
        name, *_ = operation.split()
        if name in _SAME:
            return add(_SAME[name], *operands)
        if name in _ANGLES:
            narrow = self._nodes.cast(operands[0], np.dtype(np.float32))
            return self._nodes.cast(add(_ANGLES[name], narrow), dtype)
        if name in _COMPOSED:
            return self._composed(_COMPOSED[name](*values))
        raise ConfigError(f"numpy.{name} of type {dtype} cannot be exported to ONNX")

    def _value(self, number: int) -> Value:
        return Value(self._graph, number)

    def _named(self, name: str) -> Value:
        """A result of the model that the graph did not know."""
        number = self._graph.load("node", name, np.float64)
        self._names[number] = name
        return self._value(number)

    def _composed(self, value: Value) -> str:
        (name,) = self.written([value.node])
        return name

    def _interpolated(self, number: int, table: Any) -> str:
        """Interpolate a value in a table, as ``numpy.interp`` does.

        Args:
            number: Position in the table.
            table: The arguments, the values, and the values before the first and after the last.
        """
        count, nodes, x = len(table) // 2 - 1, self._nodes, self._value(number)
        place = self._place(self._names[number], nodes.tensor(table[:count]))
        following = nodes.add("Add", place, nodes.constant(1, np.dtype(np.int64)))
        after = nodes.add("Min", following, nodes.constant(count - 1, np.dtype(np.int64)))
        low, high, first, last = (
            self._named(nodes.add("Gather", nodes.tensor(part), one))
            for part in (table[:count], table[count : 2 * count])
            for one in (place, after)
        )
        width = high - low
        slope = (last - first) / where(width == 0.0, 1.0, width)  # both are the last one
        inside = where(x < table[0], table[-2], slope * (x - low) + first)
        return self._composed(where(x > table[count - 1], table[-1], inside))

    def _place(self, x: str, arguments: str) -> str:
        """The number of the last argument that is not above x; of the first one if all are."""
        add, axis = self._nodes.add, self._nodes.tensor(np.array([-1]))
        reached = add("GreaterOrEqual", add("Unsqueeze", x, axis), arguments)
        whole = np.dtype(np.int64)
        number = add("ReduceSum", self._nodes.cast(reached, whole), axis, keepdims=0)
        place = add("Sub", number, self._nodes.constant(1, whole))
        return add("Max", place, self._nodes.constant(0, whole))
