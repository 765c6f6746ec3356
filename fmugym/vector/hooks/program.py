"""Programs: hooks in the form that the native pool runs.

A program is a list of instructions on typed registers, each for 128 environments at a time. The
native pool runs it in the same pass as the FMU's step. What IEEE 754 settles is computed by the
pool itself, everything else by the inner loops of numpy's own functions.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.pool.extension import has_native_pool

__all__ = [
    "OPERATIONS",
    "TYPES",
    "Program",
    "UntraceableError",
    "evaluate",
    "letter_of",
    "writes_variable",
]

OPERATIONS: Final = (
    *("load_row", "load_action", "load_previous_action", "load_active", "load_stopped"),
    *("store_row", "store_seen", "store_floats", "call", "call_square", "call_remainder"),
    *("call_sine", "call_cosine"),
    *("cast", "take", "interpolate"),
    *("add d", "subtract d", "multiply d", "divide d", "square d", "negative d", "absolute d"),
    *("sqrt d", "minimum d", "maximum d"),
    *("less d", "less_equal d", "greater d", "greater_equal d", "equal d", "not_equal d"),
    *("add f", "subtract f", "multiply f", "divide f", "square f", "negative f", "absolute f"),
    *("sqrt f", "minimum f", "maximum f"),
    *("add q", "subtract q", "multiply q", "negative q"),
    *("less q", "less_equal q", "greater q", "greater_equal q", "equal q", "not_equal q"),
    *("and", "or", "xor", "not", "where 8", "where 4", "where 2", "where 1"),
    *("scalar_power d", "scalar_power f"),
)
"""The operations in the order of ``enum Operation`` of ``native/program.h``."""

TYPES: Final = "dfqihbQIHB?e"
"""The types of values: letters of numpy, in the order of ``EACH_TYPE`` of ``native/program.h``."""

MOST_REGISTERS: Final = 256
"""The native pool has this many registers for each program."""

CONSTANT: Final = np.dtype([("bits", "u8"), ("to", "u2"), ("size", "u2"), ("unused", "u4")])
SLOT: Final = np.dtype([("array", "u4"), ("element", "u4"), ("elements", "u4"), ("type", "u4")])
"""The layouts of ``Constant`` and ``Slot`` in ``native/program.h``."""


def require_same_table(native: Any) -> None:
    """Compare the operations with those that the C extension was built with.

    Args:
        native: The module ``fmugym._native``.

    Raises:
        ImportError: If they differ, because the extension was built from other sources.
    """
    operations: Any = getattr(native, "operations", tuple)()
    if (operations, getattr(native, "MOST_REGISTERS", 0)) != (OPERATIONS, MOST_REGISTERS):
        raise ImportError(
            "the C extension fmugym._native was built from other sources than the Python code of "
            "fmugym: its table of operations differs. Install fmugym again, in a working copy "
            "with: pip install --no-deps --editable ."
        )


if has_native_pool():
    from fmugym import _native

    require_same_table(_native)


class UntraceableError(Exception):
    """A hook does what a program cannot do."""


_LETTERS: Final = {np.dtype(letter): letter for letter in TYPES}
"""On systems where two of numpy's types have the same layout, both are equal to one of these."""


def writes_variable(name: str) -> str:
    """Say why hooks cannot be compiled if another one than ``_update`` writes a variable."""
    return f"a hook writes the episode variable {name!r}, which only _update may do"


def letter_of(dtype: npt.DTypeLike) -> str:
    """The letter of a type.

    Raises:
        UntraceableError: If programs have no values of this type.
    """
    letter = _LETTERS.get(np.dtype(dtype))
    if letter is None:
        raise UntraceableError(f"it computes with {np.dtype(dtype)}")
    return letter


Row = tuple[Hashable, ...]
"""Names a row of values, one for each environment, such as ``("output", 0)``."""


@dataclass(frozen=True)
class Program:
    """Instructions for the native pool.

    Attributes:
        code: Operation, extra, the register to write, three operands; shape (n, 6). What extra
            means depends on the operation; see ``native/program.h``.
        constants: Registers that keep a value; of type ``CONSTANT``.
        slots: Elements of observations that are stored; of type ``SLOT``.
        calls: Loops of numpy: the capsule, the number of inputs, bytes of each input and output,
            and the number of the output that is kept, counted from the first input.
        rows: The rows that are loaded or stored.
        tables: Values to look up.
        registers: How many registers there are.
        seen: How many arrays the slots refer to.
        results: The registers of the results.
        is_always_finite: Whether no result can be infinite or NaN.
    """

    code: npt.NDArray[np.uint16]
    constants: npt.NDArray[Any]
    slots: npt.NDArray[Any]
    calls: tuple[tuple[Any, int, tuple[int, ...], int], ...]
    rows: tuple[Row, ...]
    tables: tuple[npt.NDArray[Any], ...]
    registers: int
    seen: int
    results: tuple[int, ...]
    is_always_finite: bool

    def loads(self, kind: str) -> bool:
        """Whether the program loads or stores rows, or runs operations, of this kind."""
        if kind in OPERATIONS:
            return bool((self.code[:, 0] == OPERATIONS.index(kind)).any())
        return any(row[0] == kind for row in self.rows)

    def with_rows(self, find: Callable[[Row], npt.NDArray[Any]]) -> tuple[Any, ...]:
        """The program as the native pool takes it, with the arrays of its rows."""
        rows = tuple(map(find, self.rows))
        parts = self.code.tobytes(), self.constants.tobytes(), self.slots.tobytes()
        counts = self.registers, self.seen, self.results
        return (*parts, self.calls, rows, self.tables, *counts)


def evaluate(
    program: Program,
    find: Callable[[Row], npt.NDArray[Any]],
    actions: tuple[npt.NDArray[Any], npt.NDArray[Any]],
    seen: tuple[npt.NDArray[Any], ...] = (),
) -> list[npt.NDArray[Any]]:
    """Run a program in C on M environments, outside of a step.

    Args:
        program: The program.
        find: Returns the array of a row, shape (M,); the program may write to it.
        actions: The actions and those before, environments first, shape (M, ...).
        seen: The arrays to store observations in, environments first.

    Returns:
        The results: done, truncated and reward, or nothing; each of shape (M,).

    Raises:
        IndexError: If an index is outside of its table.
    """
    count = len(actions[0])
    types: tuple[Any, ...] = (np.bool_, np.bool_, np.float64)[: len(program.results)]
    results: tuple[npt.NDArray[Any], ...] = tuple(np.zeros(count, t) for t in types)
    first, second = (np.ascontiguousarray(part).reshape(-1) for part in actions)
    elements = first.size // count
    parts = program.with_rows(find)
    if _native.evaluate(parts, count, elements, first, second, results, seen):
        raise IndexError("a hook looks up an index outside of its table")
    return list(results)
