"""Compiler from the graph of a task to instructions of the native pool."""

from __future__ import annotations

import sys
from collections.abc import Hashable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.expressions.graph import Graph, Node
from fmugym.expressions.program import (
    CONSTANT,
    MOST_REGISTERS,
    OPERATIONS,
    TYPES,
    Program,
    Row,
    UncompilableError,
    engine,
    letter_of,
    operation_of,
)

__all__ = ["Store", "compile_graph", "registers_of"]

_MOST_INSTRUCTIONS: Final = 20_000

_PARTNERS: Final = {"sin d": "cos d", "cos d": "sin d"}


class Store(NamedTuple):
    """A value to store in a row.

    Attributes:
        node: Its number.
        row: The row. One of the kind ``"seen"`` is an element of observations or infos, whose
            neighbours are those of the next numbers.
    """

    node: int
    row: Row


def compile_graph(graph: Graph, stores: Sequence[Store]) -> Program:
    """Number the operations in the order of evaluation, and place their values in registers.

    Args:
        graph: The operations.
        stores: Values to store, in this order.

    Raises:
        UncompilableError: If there are too many operations, or the pool does not have one of them.
        ImportError: If the C extension was built from other sources than this package.
    """
    engine()  # which numbers operations as this module does
    compiler = _Compiler(graph)
    rows = compiler.number_outputs(stores)
    for store, row in zip(stores, rows, strict=True):
        if row is None:
            compiler.evaluate(store.node)
            compiler.store(store)
        else:
            compiler.store_output(store, row)
    return compiler.program()


class _Step(NamedTuple):
    """An instruction before values have registers: operands are nodes, others are numbers."""

    operation: str
    extra: int
    node: int | None
    operands: tuple[int, ...]
    others: tuple[int, ...] = ()


class _Compiler:
    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._steps: list[_Step] = []
        self._known: set[int] = set()
        self._constants: list[int] = []
        self._rows: dict[Row, int] = {}
        self._tables: dict[Hashable, int] = {}

    def evaluate(self, node: int) -> None:
        """Add the instructions that a value needs."""
        for number in self._graph.needed([node], self._known):
            if number not in self._known:
                self._known.add(number)
                self._add(number, self._graph.nodes[number])

    def _add(self, number: int, node: Node) -> None:
        if node.kind == "constant":
            self._constants.append(number)
            return
        self._steps.append(_Step(*self._operation(node), number, node.operands))
        if len(self._steps) > _MOST_INSTRUCTIONS:
            raise UncompilableError(f"it has more than {_MOST_INSTRUCTIONS} operations")

    def number_outputs(self, stores: Sequence[Store]) -> list[int | None]:
        """Let the rows of outputs that are observed side by side follow each other."""
        return [self._output_row(store) for store in stores]

    def _output_row(self, store: Store) -> int | None:
        """The row of the FMU's output that it stores as a float32, as most observations do."""
        node = self._graph.nodes[store.node]
        if store.row[0] != "seen" or node.kind != "cast" or node.dtype != np.float32:
            return None
        source = self._graph.nodes[node.operands[0]]
        what: Any = source.what
        is_output = source.kind == "row" and what[0] == "output"
        return self._place(self._rows, what) if is_output else None

    def store_output(self, store: Store, row: int) -> None:
        """Store an output in the same instruction as the one before, if they are neighbours."""
        element: Any
        kind, array, element, *others = store.row
        place, before = self._place(self._rows, store.row), (kind, array, element - 1, *others)
        last = self._steps[-1] if self._steps else None
        if last is not None and last.operation == "store_floats":
            first, count = last.others
            are_neighbours = self._rows.get(before) == place - 1
            if are_neighbours and (first + count, last.extra + count) == (row, place):
                self._steps[-1] = last._replace(others=(first, count + 1))
                return
        self._steps.append(_Step("store_floats", place, None, (), (row, 1)))

    def store(self, store: Store) -> None:
        """Add the instruction that stores a value."""
        extra = self._place(self._rows, store.row)
        self._steps.append(_Step("store_row", extra, None, (store.node,)))

    def _place(self, places: dict[Any, int], key: Any) -> int:
        return places.setdefault(key, len(places))

    def _operation(self, node: Node) -> tuple[str, int]:
        """The operation and its extra."""
        what: Any = node.what
        match node.kind:
            case "row":
                return "load_row", self._place(self._rows, what)
            case "action" | "previous_action":
                return "load_row", self._place(self._rows, (node.kind, what))
            case "failed" | "stopped":
                return f"load_{node.kind}", 0
            case "take" | "interpolate":
                return node.kind, self._place(self._tables, what)
            case "where":
                return f"where {node.dtype.itemsize}", 0
        source = letter_of(self._graph.nodes[node.operands[0]].dtype)
        if node.kind == "cast":
            return "cast", TYPES.index(source) * len(TYPES) + TYPES.index(letter_of(node.dtype))
        return str(operation_of(what, source)), 0

    def program(self) -> Program:
        """Place all values in registers."""
        self._steps = _with_pairs(self._steps)
        registers = registers_of(
            [(step.node, step.operands) for step in self._steps], self._constants, ()
        )
        if max(registers.values(), default=0) >= MOST_REGISTERS:
            raise UncompilableError(f"it needs more than {MOST_REGISTERS} values at a time")
        code = np.zeros((len(self._steps), 6), np.uint16)
        for line, step in zip(code, self._steps, strict=True):
            line[:2] = OPERATIONS.index(step.operation), step.extra
            line[2] = 0 if step.node is None else registers[step.node]
            operands = [*(registers[operand] for operand in step.operands), *step.others]
            line[3 : 3 + len(operands)] = operands
        return Program(
            code,
            self._constants_in(registers),
            tuple(self._rows),
            tuple(self._graph.tables[key] for key in self._tables),
            max(registers.values(), default=0) + 1,  # instructions without one name the first
        )

    def _constants_in(self, registers: dict[int, int]) -> Any:
        constants = np.zeros(len(self._constants), CONSTANT)
        for place, number in zip(constants, self._constants, strict=True):
            bits: Any = self._graph.nodes[number].what
            place["bits"] = int.from_bytes(bits.ljust(8, b"\0"), "little")
            place["to"], place["size"] = registers[number], len(bits)
        if sys.byteorder == "little":
            return constants
        raise UncompilableError("this processor stores numbers in another order")


def _with_pairs(steps: Sequence[_Step]) -> list[_Step]:
    """Let a sine and a cosine of the same angles follow each other: the pool makes both at once."""
    known = {(step.operation, step.operands): step for step in steps}
    paired: dict[_Step, None] = {}
    for step in steps:
        partner = known.get((_PARTNERS.get(step.operation, ""), step.operands))
        paired.update(dict.fromkeys([step] if partner is None else [step, partner]))
    return list(paired)


def registers_of(
    steps: Sequence[tuple[int | None, tuple[int, ...]]],
    constants: Sequence[int],
    results: Sequence[int],
) -> dict[int, int]:
    """Give each value a register until its last use; constants keep theirs.

    Args:
        steps: The node that each step computes, if any, and its operands, in their order.
        constants: The nodes of the constants.
        results: The nodes whose values stay.
    """
    last = {operand: i for i, (_, operands) in enumerate(steps) for operand in operands}
    last |= dict.fromkeys([*constants, *results], len(steps))
    registers = {node: index for index, node in enumerate(constants)}
    free: list[int] = []
    count = len(registers)
    for index, (node, operands) in enumerate(steps):
        if node is not None:
            if not free:
                free, count = [count], count + 1
            registers[node] = free.pop()
            if node not in last:  # nobody reads it
                free.append(registers[node])
        free += [registers[operand] for operand in set(operands) if last[operand] == index]
    return registers
