"""Graph of operations on single values, which a task computes."""

from __future__ import annotations

from collections.abc import Container, Hashable, Iterable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.expressions.program import letter_of

__all__ = ["Graph", "Node"]


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
