"""Programs: compiled graphs, which the native pool runs.

A program is a list of instructions on typed registers, each for 128 environments at a time. The
native pool runs it in the same pass as the FMU's step. What IEEE 754 settles equals numpy to the
last bit. Functions such as sines and powers are those of the C library.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from fmugym.pool.c_extension import require_engine
from fmugym.pool.pool_form import form_of_program

__all__ = [
    "LETTERS",
    "OPERATIONS",
    "TYPES",
    "Program",
    "UncompilableError",
    "engine",
    "is_function",
    "letter_of",
    "operation_of",
]

T = TypeVar("T")

_OF_EACH_TYPE: Final = (
    *("add", "subtract", "multiply", "negative", "minimum", "maximum"),
    *("less", "less_equal", "greater", "greater_equal", "equal", "not_equal"),
)

_FUNCTIONS: Final = (
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh"),
    *("arcsinh", "arccosh", "arctanh", "exp", "exp2", "expm1", "log", "log2", "log10", "log1p"),
    *("cbrt", "arctan2", "hypot", "power"),
)
"""Functions of the C library, whose last bits may differ from numpy's."""

OPERATIONS: Final = (
    *("load_row", "load_failed", "load_stopped"),
    *("store_row", "store_floats", "cast", "take", "interpolate"),
    *(f"{name} {letter}" for letter in "dfq" for name in _OF_EACH_TYPE),
    *(f"{name} {letter}" for name in ("divide", "absolute", "sqrt") for letter in "df"),
    *("floor d", "ceil d", "trunc d", "rint d"),
    *("bitwise_and q", "bitwise_xor q", "right_shift q"),
    *("and", "or", "xor", "not", "where 8", "where 4", "where 1"),
    *(f"{name} d" for name in _FUNCTIONS),
    *("power f", "fmod d", "copysign d"),
    *(f"{name} {letter}" for letter in "dq" for name in ("remainder", "floor_divide")),
)
"""The operations in the order of ``enum Operation`` of ``native/program/program.h``."""

TYPES: Final = "dfq?b"
"""The types of values: letters of numpy, in the order of ``VALUE_DOUBLE`` and so on there.

There is no arithmetic with int8, the type of ``MultiBinary``: such values are only converted.
"""

MOST_REGISTERS: Final = 256
"""The native pool has this many registers for each program."""

CONSTANT: Final = np.dtype([("bits", "u8"), ("to", "u2"), ("size", "u2"), ("unused", "u4")])
"""The layout of ``Constant`` in ``native/program/program.h``."""


def require_same_table(native: Any) -> None:
    """Compare the list of operations with that of the C extension.

    Args:
        native: The module ``fmugym._native``.

    Raises:
        ImportError: If they differ, because the extension was built from other sources.
    """
    operations: Any = getattr(native, "OPERATIONS", ())
    if (operations, getattr(native, "MOST_REGISTERS", 0)) != (OPERATIONS, MOST_REGISTERS):
        raise ImportError(
            "the C extension fmugym._native was built from other sources than the Python code of "
            "fmugym: its table of operations differs. Install fmugym again, in a working copy "
            "with: pip install --no-deps --editable ."
        )


@functools.cache
def engine() -> Any:
    """The C extension, which must have been built from the same sources as this module."""
    require_engine("a program")
    from fmugym import _native

    require_same_table(_native)
    return _native


class UncompilableError(Exception):
    """An expression contains an operation that programs lack."""


LETTERS: Final = {np.dtype(letter): letter for letter in TYPES}
"""The letters of the types that programs have."""


def letter_of(dtype: npt.DTypeLike) -> str:
    """The letter of a type.

    Raises:
        UncompilableError: If programs have no values of this type.
    """
    letter = LETTERS.get(np.dtype(dtype))
    if letter is None:
        raise UncompilableError(f"it computes with {np.dtype(dtype)}")
    return letter


_OF_FLAGS: Final = {
    **dict.fromkeys(("logical_and", "bitwise_and", "multiply", "minimum"), "and"),
    **dict.fromkeys(("logical_or", "bitwise_or", "add", "maximum"), "or"),
    **dict.fromkeys(("logical_xor", "bitwise_xor", "not_equal"), "xor"),
    **dict.fromkeys(("logical_not", "invert"), "not"),
}
"""The operations that functions of numpy are for Booleans."""


@functools.cache
def operation_of(ufunc: np.ufunc, letter: str) -> str | None:
    """The operation that computes a function of numpy of values of one type, if there is one."""
    if letter == "?":
        return _OF_FLAGS.get(ufunc.__name__)
    name = "power" if ufunc is np.float_power else ufunc.__name__
    return f"{name} {letter}" if f"{name} {letter}" in OPERATIONS else None


def is_function(operation: str) -> bool:
    """Whether an operation is a function of the C library, which takes longer than arithmetic."""
    return operation.partition(" ")[0] in _FUNCTIONS


Row = tuple[Hashable, ...]
"""Names a row of values, one for each environment, such as ``("output", 0)``."""


@dataclass(frozen=True)
class Program:
    """Instructions for the native pool: a function from rows to rows, element by element.

    Attributes:
        code: Operation, extra, the register to write, three operands; shape (n, 6). What extra
            means depends on the operation; see ``native/program/program.h``.
        constants: Registers that keep a value; of type ``CONSTANT``.
        rows: The rows that are loaded or stored.
        tables: Values to look up.
        registers: How many registers there are.
    """

    code: npt.NDArray[np.uint16]
    constants: npt.NDArray[Any]
    rows: tuple[Row, ...]
    tables: tuple[npt.NDArray[Any], ...]
    registers: int

    def loads(self, kind: str) -> bool:
        """Whether the program loads or stores rows of this kind."""
        return any(row[0] == kind for row in self.rows)

    def with_tables(self, tables: Mapping[bytes, npt.NDArray[Any]]) -> Program:
        """Return the program with other tables, by the bytes of the tables that they replace."""
        return replace(self, tables=tuple(tables.get(own.tobytes(), own) for own in self.tables))

    def with_rows(self, find: Callable[[Row], T]) -> tuple[bytes, tuple[T, ...]]:
        """The program as the native pool takes it: its form, and what it finds for its rows."""
        code, constants = self.code.tobytes(), self.constants.tobytes()
        form = form_of_program(code, constants, self.tables, self.registers)
        return form, tuple(map(find, self.rows))
