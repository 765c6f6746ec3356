"""From the graph of what hooks compute to instructions for the native pool."""

from __future__ import annotations

import sys
from collections.abc import Hashable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.vector.hooks.graph import Graph, Node
from fmugym.vector.hooks.loops import has_known_sines, loop_of, squares_nearly_exactly
from fmugym.vector.hooks.program import (
    CONSTANT,
    MOST_REGISTERS,
    OPERATIONS,
    SLOT,
    TYPES,
    Program,
    Row,
    UntraceableError,
    letter_of,
)

__all__ = ["Store", "compile_graph"]

_MOST_INSTRUCTIONS: Final = 20_000

_OF_FLAGS: Final[dict[Any, str]] = {
    np.logical_and: "and",
    np.bitwise_and: "and",
    np.logical_or: "or",
    np.bitwise_or: "or",
    np.logical_xor: "xor",
    np.bitwise_xor: "xor",
    np.not_equal: "xor",
    np.logical_not: "not",
    np.invert: "not",
}
"""Functions of Booleans that the pool computes itself."""

_OF_ANGLES: Final[dict[Any, str]] = {np.sin: "call_sine", np.cos: "call_cosine"}
"""Functions of which the pool computes most values itself."""

_NAMES: Final[dict[Any, str]] = {np.fabs: "absolute"}
"""Other names of functions that the pool computes itself."""


class Store(NamedTuple):
    """A value to store: in a row, or as the element of an array of observations.

    Attributes:
        node: Its number.
        row: The row; None for an element.
        slot: The number of the array, the element, and the number of elements of an environment.
    """

    node: int
    row: Row | None
    slot: tuple[int, int, int] = (0, 0, 0)


def compile_graph(
    graph: Graph, stores: Sequence[Store], results: Sequence[int], seen: int
) -> Program:
    """Number the operations in the order of evaluation, and place their values in registers.

    Args:
        graph: The operations.
        stores: What to store, in this order.
        results: The nodes of the results.
        seen: The number of arrays of observations.

    Raises:
        UntraceableError: If there are too many operations, or the pool does not have one of them.
    """
    compiler = _Compiler(graph)
    compiler.number_outputs(stores)
    for store in stores:
        if compiler.observes_output(store):
            compiler.store_output(store)
        else:
            compiler.evaluate(store.node)
            compiler.store(store)
    for node in results:
        compiler.evaluate(node)
    return compiler.program(results, seen)


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
        self._calls: dict[Hashable, int] = {}
        self._tables: dict[Hashable, int] = {}
        self._slots: list[tuple[int, int, int, int]] = []

    def evaluate(self, node: int) -> None:
        """Add the instructions that a value needs."""
        waiting = [(node, False)]
        while waiting:
            number, has_operands = waiting.pop()
            if has_operands:
                self._add(number, self._graph.nodes[number])
            elif number not in self._known:
                self._known.add(number)
                operands = self._graph.nodes[number].operands
                waiting.append((number, True))
                waiting.extend((operand, False) for operand in reversed(operands))

    def _add(self, number: int, node: Node) -> None:
        if node.kind == "constant":
            self._constants.append(number)
            return
        if node.kind == "missing":
            raise UntraceableError(str(node.what))
        operation, extra = self._operation(node)
        if operation == "call_cosine":
            self._add_sibling(node, np.sin)
        self._steps.append(_Step(operation, extra, number, node.operands))
        if operation == "call_sine":
            self._add_sibling(node, np.cos)
        if len(self._steps) > _MOST_INSTRUCTIONS:
            raise UntraceableError(f"it has more than {_MOST_INSTRUCTIONS} operations")

    def _add_sibling(self, node: Node, ufunc: np.ufunc) -> None:
        """Put the sine and the cosine of an angle side by side: the pool computes both at once."""
        number = self._graph.find(node._replace(what=ufunc))
        if number is not None and number not in self._known:
            self.evaluate(number)

    def observes_output(self, store: Store) -> bool:
        """Whether it stores an output of the FMU as a float32, as most observations do."""
        node = self._graph.nodes[store.node]
        if store.row is not None or node.kind != "cast" or node.dtype != np.float32:
            return False
        source = self._graph.nodes[node.operands[0]]
        what: Any = source.what
        return source.kind == "row" and what[0] == "output"

    def _output_row(self, store: Store) -> int:
        node = self._graph.nodes[self._graph.nodes[store.node].operands[0]]
        return self._place(self._rows, node.what)

    def number_outputs(self, stores: Sequence[Store]) -> None:
        """Let the rows of outputs that are observed side by side follow each other."""
        for store in filter(self.observes_output, stores):
            self._output_row(store)

    def store_output(self, store: Store) -> None:
        """Store an output in the same instruction as the one before, if they are neighbours."""
        row, slot = self._output_row(store), len(self._slots)
        self._slots.append((*store.slot, TYPES.index("f")))
        last = self._steps[-1] if self._steps else None
        if last is not None and last.operation == "store_floats":
            first, count = last.others
            array, element, _ = store.slot
            if (first + count, last.extra + count) == (row, slot) and self._slots[-2][:2] == (
                array,
                element - 1,
            ):
                self._steps[-1] = last._replace(others=(first, count + 1))
                return
        self._steps.append(_Step("store_floats", slot, None, (), (row, 1)))

    def store(self, store: Store) -> None:
        """Add the instruction that stores a value."""
        if store.row is not None:
            extra = self._place(self._rows, store.row)
            self._steps.append(_Step("store_row", extra, None, (store.node,)))
            return
        letter = letter_of(self._graph.nodes[store.node].dtype)
        self._slots.append((*store.slot, TYPES.index(letter)))
        self._steps.append(_Step("store_seen", len(self._slots) - 1, None, (store.node,)))

    def _place(self, places: dict[Any, int], key: Any) -> int:
        return places.setdefault(key, len(places))

    def _operation(self, node: Node) -> tuple[str, int]:
        """The operation and its extra."""
        what: Any = node.what
        match node.kind:
            case "row":
                return "load_row", self._place(self._rows, what)
            case "action" | "previous_action":
                return f"load_{node.kind}", what
            case "active" | "stopped":
                return f"load_{node.kind}", 0
            case "take" | "interpolate":
                return node.kind, self._place(self._tables, what)
            case "where":
                return f"where {node.dtype.itemsize}", 0
            case "scalar_power":
                return f"scalar_power {letter_of(node.dtype)}", 0
            case "cast":
                source, target = self._letters(node)[0], letter_of(node.dtype)
                return "cast", TYPES.index(source) * len(TYPES) + TYPES.index(target)
            case "part":
                ufunc, index, results = what
                return "call", self._call(node, ufunc, results, index)
        return self._function(node, what)

    def _letters(self, node: Node) -> list[str]:
        return [letter_of(self._graph.nodes[operand].dtype) for operand in node.operands]

    def _function(self, node: Node, ufunc: np.ufunc) -> tuple[str, int]:
        letters = self._letters(node)
        if set(letters) == {"?"} and ufunc in _OF_FLAGS:
            return _OF_FLAGS[ufunc], 0
        name = f"{_NAMES.get(ufunc, ufunc.__name__)} {letters[0]}"
        if len(set(letters)) == 1 and name in OPERATIONS:
            return name, 0
        call = self._call(node, ufunc, (node.dtype,), 0)
        return self._quick_name(node, ufunc), call

    def _call(
        self, node: Node, ufunc: np.ufunc, results: tuple[np.dtype[Any], ...], index: int
    ) -> int:
        """The number of a call of one of numpy's loops that keeps one of its results."""
        if len(node.operands) > 3:
            raise UntraceableError(f"numpy.{ufunc.__name__} has more than three arguments")
        types = *(self._graph.nodes[operand].dtype for operand in node.operands), *results
        loop_of(ufunc, types)
        return self._place(self._calls, (ufunc, types, self._constant(node), index))

    def _constant(self, node: Node) -> tuple[bool, ...]:
        return tuple(self._graph.nodes[operand].kind == "constant" for operand in node.operands)

    def _quick_name(self, node: Node, ufunc: np.ufunc) -> str:
        """The operation that calls a loop: one that needs no call for most values, if there is."""
        if set(self._letters(node)) == {"d"}:
            if ufunc is np.remainder:
                return "call_remainder"
            if ufunc in _OF_ANGLES and has_known_sines():
                return _OF_ANGLES[ufunc]
        return "call_square" if self._is_square(node, ufunc) else "call"

    def _is_square(self, node: Node, ufunc: np.ufunc) -> bool:
        if ufunc is not np.float_power or self._constant(node) != (False, True):
            return False
        bits: Any = self._graph.nodes[node.operands[1]].what
        is_two = node.dtype == np.float64 and bits == np.float64(2.0).tobytes()
        return is_two and squares_nearly_exactly()

    def program(self, results: Sequence[int], seen: int) -> Program:
        """Place all values in registers."""
        registers = self._registers(results)
        code = np.zeros((len(self._steps), 6), np.uint16)
        for line, step in zip(code, self._steps, strict=True):
            line[:2] = OPERATIONS.index(step.operation), step.extra
            line[2] = 0 if step.node is None else registers[step.node]
            operands = [*(registers[operand] for operand in step.operands), *step.others]
            line[3 : 3 + len(operands)] = operands
        return Program(
            code,
            self._constants_in(registers),
            np.array(self._slots, SLOT),
            tuple(_call(*call) for call in self._calls),  # type: ignore[misc]  # mypy does not follow *call
            tuple(self._rows),
            tuple(self._graph.tables[key] for key in self._tables),
            max(registers.values(), default=-1) + 1,
            seen,
            tuple(registers[node] for node in results),
            all(map(self._graph.is_always_finite, results)),
        )

    def _registers(self, results: Sequence[int]) -> dict[int, int]:
        """Give each value a register until its last use; constants keep theirs."""
        last = {operand: i for i, step in enumerate(self._steps) for operand in step.operands}
        last.update(dict.fromkeys(results, len(self._steps)))
        registers = {node: index for index, node in enumerate(self._constants)}
        free: list[int] = []
        count = len(registers)
        for index, step in enumerate(self._steps):
            if step.node is not None:
                if not free:
                    free, count = [count], count + 1
                registers[step.node] = free.pop()
                if step.node not in last:  # nobody reads it
                    free.append(registers[step.node])
            for operand in set(step.operands):
                if last[operand] == index and operand not in self._constants:
                    free.append(registers[operand])
        if count > MOST_REGISTERS:
            raise UntraceableError(f"it needs more than {MOST_REGISTERS} values at a time")
        return registers

    def _constants_in(self, registers: dict[int, int]) -> Any:
        constants = np.zeros(len(self._constants), CONSTANT)
        for place, number in zip(constants, self._constants, strict=True):
            bits: Any = self._graph.nodes[number].what
            place["bits"] = int.from_bytes(bits.ljust(8, b"\0"), "little")
            place["to"], place["size"] = registers[number], len(bits)
        if sys.byteorder == "little":
            return constants
        raise UntraceableError("this processor stores numbers in another order")


def _call(
    ufunc: np.ufunc, types: tuple[np.dtype[Any], ...], constant: tuple[bool, ...], index: int
) -> tuple[Any, int, tuple[int, ...], int]:
    """A loop and its strides. Constants have none, as numbers in hooks on arrays.

    Loops may do something else then: ``numpy.power`` squares if the exponent is 2.
    """
    inputs = len(constant)
    sizes = [0 if same else t.itemsize for t, same in zip(types, constant, strict=False)]
    sizes += [t.itemsize for t in types[inputs:]]
    return loop_of(ufunc, types), inputs, tuple(sizes), inputs + index
