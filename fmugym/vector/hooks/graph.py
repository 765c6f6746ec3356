"""What hooks compute, as a graph of operations on single values."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Hashable, Mapping
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.vector.hooks.program import UntraceableError, letter_of

__all__ = ["CLIP", "Cell", "Graph", "Node"]


class Node(NamedTuple):
    """A value of one environment, and how it is computed.

    Attributes:
        kind: ``constant``, ``row``, ``action``, ``previous_action``, ``active``, ``stopped``,
            ``missing``, ``ufunc``, ``part``, ``cast``, ``where``, ``take`` or ``interpolate``.
        what: The value, the row, the element, the reason, the function or the table.
        operands: The numbers of the nodes that it is computed from.
        dtype: The type of the value.
    """

    kind: str
    what: Hashable
    operands: tuple[int, ...]
    dtype: np.dtype[Any]


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
        is_inexact: Whether the last bits of results may differ from those of hooks on arrays.
        array_type: The class of symbolic arrays, if it is not ``Symbols``.
    """

    array_type: Any = None

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._numbers: dict[Node, int] = {}
        self.tables: dict[Hashable, npt.NDArray[Any]] = {}
        self.is_inexact = False

    def node(self, cell: Cell) -> Node:
        """The node of a cell."""
        return self.nodes[cell.node]

    def load(self, kind: str, what: Hashable, dtype: npt.DTypeLike, lane: int | None) -> Cell:
        """A value that the program finds."""
        return Cell(self._number(Node(kind, what, (), np.dtype(dtype))), lane)

    def constant(self, value: Any, dtype: np.dtype[Any]) -> Cell:
        """A value that is known. Zeros of different sign are two constants."""
        letter_of(dtype)
        bits = np.array(value, dtype).tobytes()
        return Cell(self._number(Node("constant", bits, (), dtype)), None)

    def value(self, cell: Cell) -> Any:
        """The value of a constant; None for anything else."""
        node = self.node(cell)
        if node.kind != "constant":
            return None
        bits: Any = node.what
        return np.frombuffer(bits, node.dtype)[0]

    def compute(
        self, kind: str, what: Any, cells: tuple[Cell, ...], dtype: np.dtype[Any], fold: Any
    ) -> Cell:
        """A value computed from others; that of constants is computed at once."""
        letter_of(dtype)
        lanes = {cell.lane for cell in cells if cell.lane is not None}
        if len(lanes) > 1:
            raise UntraceableError("it mixes the values of several environments")
        if not lanes and all(self.node(cell).kind == "constant" for cell in cells):
            values = [np.array([self.value(cell)]) for cell in cells]
            with np.errstate(all="ignore"):
                return self.constant(fold(*values)[0], dtype)
        operands = tuple(cell.node for cell in cells)
        return Cell(self._number(Node(kind, what, operands, dtype)), lanes.pop() if lanes else None)

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
        """A function of numpy of values that have the types of one of its loops."""
        if ufunc in _IDENTITIES:
            return cells[0]
        if ufunc is CLIP and dtype.kind == "f" and all(map(self._is_limit, cells[1:])):
            value, low, high = cells
            raised = self.apply(np.maximum, (value, low), dtype)
            return self.apply(np.minimum, (raised, high), dtype)
        _require_free(self, ufunc, cells, dtype)
        return self.compute("ufunc", ufunc, cells, dtype, ufunc)

    def _is_limit(self, cell: Cell) -> bool:
        """Whether it is a constant to which ``numpy.clip`` limits as minimum and maximum do.

        Of zeros with different signs and of NaNs, they may choose different ones.
        """
        value = self.value(cell)
        return value is not None and bool(value != 0.0) and not np.isnan(value)

    def part(
        self,
        ufunc: np.ufunc,
        index: int,
        cells: tuple[Cell, ...],
        dtypes: tuple[np.dtype[Any], ...],
    ) -> Cell:
        """One of the results, whose types these are, of a function with several results."""
        what = ufunc, index, dtypes
        return self.compute("part", what, cells, dtypes[index], lambda *v: ufunc(*v)[index])

    def patched(self, own: Callable[..., Any], function: Any, args: Any, keywords: Any) -> Any:
        """Call what stands for a function of numpy that does not ask its arguments."""
        return own(self, function, *args, **keywords)

    def find(self, node: Node) -> int | None:
        """The number of an equal node; None if there is none."""
        return self._numbers.get(node)

    def _number(self, node: Node) -> int:
        number = self._numbers.setdefault(node, len(self.nodes))
        if number == len(self.nodes):
            self.nodes.append(node)
        return number

    def is_always_finite(self, number: int) -> bool:
        """Whether a value can be neither infinite nor NaN, whatever the program loads.

        The values that a program loads are finite: the pool does not step with other inputs, and
        an FMU with other outputs has failed. A bound of all magnitudes shows where arithmetic may
        overflow.
        """
        bounds: list[float] = []
        for node in self.nodes[: number + 1]:
            bounds.append(self._bound(node, [bounds[operand] for operand in node.operands]))
        return bounds[number] <= _LARGEST

    def _bound(self, node: Node, bounds: list[float]) -> float:
        if node.dtype.kind in "biu":
            return _LARGEST if node.dtype.kind != "b" else 1.0
        if node.kind == "constant":
            bits: Any = node.what
            constant = abs(float(np.frombuffer(bits, node.dtype)[0]))
            return constant if constant <= _LARGEST else math.inf  # a NaN, too
        if node.dtype.itemsize < 8:
            return math.inf
        if node.kind == "ufunc":
            return _BOUNDS[node.what](bounds) if node.what in _BOUNDS else math.inf
        if node.kind == "row":
            row: Any = node.what
            return _LARGEST if row[0] in _FINITE_ROWS else math.inf
        if node.kind == "cast":
            return bounds[0]
        return max(bounds[1:]) if node.kind == "where" else math.inf


_LARGEST: Final = sys.float_info.max

_FINITE_ROWS: Final = frozenset({"output", "kept", "input", "parameter"})

CLIP: Final[np.ufunc] = import_module("numpy._core._multiarray_umath").clip
"""What ``numpy.clip`` calls. Numpy 1.26 has it under this name, too."""

_IDENTITIES: Final = frozenset({np.positive, np.conjugate})

_BOUNDS: Final[Mapping[Any, Callable[[list[float]], float]]] = {
    np.add: sum,
    np.subtract: sum,
    np.multiply: lambda bounds: bounds[0] * bounds[1],
    np.square: lambda bounds: bounds[0] * bounds[0],
    np.negative: max,
    np.absolute: max,
    np.fabs: max,
    np.minimum: max,
    np.maximum: max,
}
"""Bounds of the magnitudes of results."""


def _require_free(
    graph: Graph, ufunc: np.ufunc, cells: tuple[Cell, ...], dtype: np.dtype[Any]
) -> None:
    """Refuse loops that may raise an exception: integers to a negative power do."""
    if ufunc is np.power and dtype.kind == "i" and _may_be_negative(graph, cells[1]):
        raise UntraceableError("it raises integers to a power that is not a constant")


def _may_be_negative(graph: Graph, cell: Cell) -> bool:
    exponent, node = graph.value(cell), graph.node(cell)
    if exponent is not None:
        return bool(exponent < 0)
    return node.kind != "cast" or graph.nodes[node.operands[0]].dtype.kind not in "ub"
