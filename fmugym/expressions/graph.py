"""Graph of operations on single values, which a task computes: numbers and conditions.

The graph is made when a task is loaded: equal nodes stand in it once, and what consists of
constants is computed at once. Its operations are those of programs, see
``fmugym.expressions.program``. The formulas of a task are around the steps of its FMU: updates,
rewards and ends in one graph.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Container, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError
from fmugym.expressions.program import letter_of, operation_of
from fmugym.expressions.quantities import QUANTITIES

__all__ = ["Computed", "Formulas", "Graph", "Node", "Update", "Value", "where"]


class Node(NamedTuple):
    """A node of a graph: one value of one environment, computed or read.

    Attributes:
        kind: ``constant``, ``row``, ``action``, ``previous_action``, ``active``, ``stopped``,
            ``ufunc``, ``cast``, ``where``, ``take`` or ``interpolate``.
        what: The value, the row, the element, the function or the table.
        operands: The numbers of the nodes that it is computed from.
        dtype: The type of the value.
    """

    kind: str
    what: Hashable
    operands: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def number(self) -> Any:
        """The value of a constant."""
        bits: Any = self.what
        return np.frombuffer(bits, self.dtype)[0]


class Graph:
    """The nodes of one program or task, equal ones once. Nodes go by their numbers.

    Attributes:
        nodes: The nodes, each behind its operands.
        tables: The values to look up.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._numbers: dict[Node, int] = {}
        self.tables: dict[Hashable, npt.NDArray[Any]] = {}

    def needed(self, numbers: Iterable[int], known: Container[int] = ()) -> list[int]:
        """The numbers of some nodes, and of all that they are computed from.

        Args:
            numbers: Numbers of the nodes.
            known: Nodes whose values are known, so that they need no others.

        Returns:
            The numbers in the order of evaluation, which is the same in any graph.
        """
        found, order = set[int](), list[int]()
        waiting = [(number, False) for number in numbers][::-1]
        while waiting:
            number, has_operands = waiting.pop()
            if has_operands:
                order.append(number)
            elif number not in found:
                found.add(number)
                operands = () if number in known else self.nodes[number].operands
                waiting.append((number, True))
                waiting.extend((operand, False) for operand in reversed(operands))
        return order

    def load(self, kind: str, what: Hashable, dtype: npt.DTypeLike) -> int:
        """A value that the program finds."""
        return self.add(kind, what, (), np.dtype(dtype))

    def constant(self, value: Any, dtype: np.dtype[Any]) -> int:
        """A value that is known. Zeros of different sign are two constants."""
        letter_of(dtype)
        return self.add("constant", np.array(value, dtype).tobytes(), (), dtype)

    def value(self, number: int) -> Any:
        """The value of a constant; None for anything else."""
        node = self.nodes[number]
        return node.number if node.kind == "constant" else None

    def compute(
        self, kind: str, what: Any, operands: tuple[int, ...], dtype: np.dtype[Any], fold: Any
    ) -> int:
        """Add a node for an operation; ``fold`` computes an operation on constants at once.

        Raises:
            UncompilableError: If programs have no values of this type.
        """
        letter_of(dtype)
        if all(self.nodes[number].kind == "constant" for number in operands):
            values = [np.array([self.value(number)]) for number in operands]
            with np.errstate(all="ignore"):
                return self.constant(fold(*values)[0], dtype)
        return self.add(kind, what, operands, dtype)

    def add(self, kind: str, what: Any, operands: tuple[int, ...], dtype: np.dtype[Any]) -> int:
        """A node, which may stand in the graph already."""
        node = Node(kind, what, operands, dtype)
        number = self._numbers.setdefault(node, len(self.nodes))
        if number == len(self.nodes):
            self.nodes.append(node)
        return number

    def cast(self, number: int, dtype: np.dtype[Any]) -> int:
        """The value in another type."""
        source = self.nodes[number].dtype
        if source == dtype:
            return number
        letter_of(source)
        return self.compute("cast", None, (number,), dtype, lambda value: value.astype(dtype))

    def choose(self, condition: int, first: int, second: int) -> int:
        """Add a node for the first value if a condition holds, otherwise the second."""
        if first == second:
            return first
        dtype = self.nodes[first].dtype
        return self.compute("where", None, (condition, first, second), dtype, np.where)


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

Update = Mapping[str, Value | Sequence[Value]]
"""New values of episode variables by name; all of them are computed before one is written."""


@dataclass(frozen=True)
class Formulas:
    """The formulas of a task, in the order of a step.

    Attributes:
        graph: Has all of them.
        inputs: The FMU's inputs; None for the elements of the action.
        updates: Values that are written to episode variables after a step, one after the other.
        terminated: Whether the task has ended; None for never.
        truncated: Whether the episode is cut off; None for never.
        reward: The reward; None if a hook of a class tells it.
        observation: The elements of the observation; None for the outputs.
        info: Facts about the step by name.
    """

    graph: Graph
    inputs: Sequence[Value] | None
    updates: Sequence[Update]
    terminated: Value | None
    truncated: Value | None
    reward: Value | None
    observation: Sequence[Value] | None
    info: Mapping[str, Computed]
