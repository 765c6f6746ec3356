"""What hooks compute, as a graph of operations on single values."""

from __future__ import annotations

from collections.abc import Container, Hashable, Iterable
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.expressions.program import UntraceableError, is_function, letter_of, operation_of

__all__ = ["TOLERANCES", "Cell", "Graph", "Node"]


_array: Final = np.array  # while hooks are traced, another function stands in its place


class Node(NamedTuple):
    """A value of one environment, and how it is computed.

    Attributes:
        kind: ``constant``, ``row``, ``action``, ``previous_action``, ``active``, ``stopped``,
            ``missing``, ``ufunc``, ``cast``, ``where``, ``take`` or ``interpolate``.
        what: The value, the row, the element, the reason, the function or the table.
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


class Cell:
    """An element of a symbolic array: a node for the environment in one lane.

    Args:
        node: The number of the node.
        lane: The place of the environment on its axis; None if the value is the same for all.
    """

    __slots__ = ("lane", "node")

    def __init__(self, node: int, lane: int | None) -> None:
        self.node, self.lane = node, lane


class Graph:
    """The nodes of one program, equal ones once.

    Attributes:
        tables: The values to look up.
        tolerance: How far results may differ from those of hooks on arrays, relative to the largest
            one.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._numbers: dict[Node, int] = {}
        self.tables: dict[Hashable, npt.NDArray[Any]] = {}
        self.tolerance = 0.0

    def tolerate(self, dtype: np.dtype[Any]) -> None:
        """Note that values of this type are not computed as numpy computes them."""
        self.tolerance = max(self.tolerance, TOLERANCES[dtype.itemsize])

    def node(self, cell: Cell) -> Node:
        """The node of a cell."""
        return self.nodes[cell.node]

    def needed(self, numbers: Iterable[int], known: Container[int] = ()) -> list[int]:
        """The numbers of some nodes, and of all that they are computed from.

        Args:
            numbers: Those of the nodes.
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

    def load(self, kind: str, what: Hashable, dtype: npt.DTypeLike, lane: int | None) -> Cell:
        """A value that the program finds."""
        return Cell(self._number(Node(kind, what, (), np.dtype(dtype))), lane)

    def constant(self, value: Any, dtype: np.dtype[Any]) -> Cell:
        """A value that is known. Zeros of different sign are two constants."""
        letter_of(dtype)
        bits = _array(value, dtype).tobytes()
        return Cell(self._number(Node("constant", bits, (), dtype)), None)

    def value(self, cell: Cell) -> Any:
        """The value of a constant; None for anything else."""
        node = self.node(cell)
        return node.number if node.kind == "constant" else None

    def compute(
        self, kind: str, what: Any, cells: tuple[Cell, ...], dtype: np.dtype[Any], fold: Any
    ) -> Cell:
        """A value computed from others; that of constants is computed at once."""
        letter_of(dtype)
        lanes = {cell.lane for cell in cells if cell.lane is not None}
        if len(lanes) > 1:
            raise UntraceableError("it mixes the values of several environments")
        if not lanes and all(self.node(cell).kind == "constant" for cell in cells):
            values = [_array([self.value(cell)]) for cell in cells]
            with np.errstate(all="ignore"):
                return self.constant(fold(*values)[0], dtype)
        return Cell(self.add(kind, what, cells, dtype).node, lanes.pop() if lanes else None)

    def add(self, kind: str, what: Any, cells: tuple[Cell, ...], dtype: np.dtype[Any]) -> Cell:
        """A node as it is in another graph, the same for all environments."""
        operands = tuple(cell.node for cell in cells)
        return Cell(self._number(Node(kind, what, operands, dtype)), None)

    def cast(self, cell: Cell, dtype: np.dtype[Any]) -> Cell:
        """The value in another type."""
        source = self.node(cell).dtype
        if source == dtype:
            return cell
        letter_of(source)
        return self.compute("cast", None, (cell,), dtype, lambda value: value.astype(dtype))

    def choose(self, condition: Cell, first: Cell, second: Cell) -> Cell:
        """The first value where the condition holds, otherwise the second; of the same type."""
        if first.node == second.node and first.lane == second.lane:
            return first
        dtype = self.node(first).dtype
        return self.compute("where", None, (condition, first, second), dtype, np.where)

    def apply(self, ufunc: np.ufunc, cells: tuple[Cell, ...], dtype: np.dtype[Any]) -> Cell:
        """A function of numpy of values that have the types of one of its loops.

        Raises:
            UntraceableError: If programs do not have it for these types.
        """
        if ufunc is np.positive:
            return cells[0]
        letters = {letter_of(self.node(cell).dtype) for cell in cells}
        operation = operation_of(ufunc, letters.pop()) if len(letters) == 1 else None
        if operation is None:
            raise UntraceableError(f"it uses numpy.{ufunc.__name__} of {dtype}")
        if is_function(operation):
            self.tolerate(dtype)
        return self.compute("ufunc", ufunc, cells, dtype, ufunc)

    def _number(self, node: Node) -> int:
        number = self._numbers.setdefault(node, len(self.nodes))
        if number == len(self.nodes):
            self.nodes.append(node)
        return number


TOLERANCES: Final = {4: 1e-5, 8: 1e-12}
"""By bytes of a float."""
