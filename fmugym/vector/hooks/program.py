"""Programs: hooks in the form that the native pool runs.

A program is a list of instructions on registers. The native pool runs it in the same pass as the
FMU's step; ``evaluate`` runs it with numpy, so that the two can be compared.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.pool.base import FloatArray
from fmugym.pool.extension import has_native_pool
from fmugym.task.readings import Readings

__all__ = [
    "MOST_INSTRUCTIONS",
    "OPERATIONS",
    "Program",
    "UntraceableError",
    "evaluate",
    "is_always_finite",
]

OPERATIONS: Final = (
    "output",
    "input",
    "action",
    "parameter",
    "step_count",
    "constant",
    "add",
    "subtract",
    "multiply",
    "divide",
    "negative",
    "absolute",
    "square_root",
    "minimum",
    "maximum",
    "less",
    "less_equal",
    "greater",
    "greater_equal",
    "equal",
    "not_equal",
    "and",
    "or",
    "not",
    "where",
)
"""The operations in the order of ``enum Operation`` of ``native/program.h``."""

MOST_INSTRUCTIONS: Final = 128
"""The native pool has this many registers."""


def require_same_table(native: Any) -> None:
    """Compare the operations with those that the C extension was built with.

    Args:
        native: The module ``fmugym._native``.

    Raises:
        ImportError: If they differ, because the extension was built from other sources.
    """
    operations: Any = getattr(native, "operations", tuple)()
    if (operations, getattr(native, "MOST_INSTRUCTIONS", 0)) != (OPERATIONS, MOST_INSTRUCTIONS):
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


@dataclass(frozen=True)
class Program:
    """Instructions for the native pool. Instruction number i writes register i.

    Attributes:
        code: The operation and three operands (registers, or the index of the value to load),
            shape (n, 4).
        constants: What the instructions of the operation ``constant`` refer to, shape (c,).
        results: The registers of the results, shape (r,).
    """

    code: npt.NDArray[np.uint16]
    constants: npt.NDArray[np.float64]
    results: npt.NDArray[np.uint16]


def is_always_finite(program: Program, result: int) -> bool:
    """Whether a result can be neither infinite nor NaN, whatever the program loads.

    The values that a program loads are finite: the pool does not step with other inputs, and an FMU
    with other outputs has failed. So a bound of all magnitudes shows where arithmetic may overflow.
    """
    bounds: list[float] = []
    for number, *operands in program.code.tolist():
        operation = OPERATIONS[number]
        if operation == "constant":
            constant = abs(float(program.constants[operands[0]]))
            bounds.append(constant if constant <= _LARGEST else math.inf)  # a NaN, too
        elif operation in _BOUNDS:
            a, b, c = (bounds[operand] if operand < len(bounds) else 0.0 for operand in operands)
            bounds.append(_BOUNDS[operation](a, b, c))
        else:
            bounds.append(_LARGEST if operation in _LOADED else 1.0)
    return bounds[int(program.results[result])] <= _LARGEST


_LARGEST: Final = sys.float_info.max
_LOADED: Final = frozenset({"output", "input", "action", "parameter", "step_count"})

_BOUNDS: Final[Mapping[str, Callable[[float, float, float], float]]] = {
    "add": lambda a, b, _: a + b,
    "subtract": lambda a, b, _: a + b,
    "multiply": lambda a, b, _: a * b,
    "divide": lambda *_: math.inf,
    "negative": lambda a, *_: a,
    "absolute": lambda a, *_: a,
    "square_root": lambda *_: math.inf,  # it is NaN for a negative number
    "minimum": lambda a, b, _: max(a, b),
    "maximum": lambda a, b, _: max(a, b),
    "where": lambda _, b, c: max(b, c),
}
"""Bounds of the magnitudes of results; comparisons and logic give 0 or 1."""


def evaluate(program: Program, batch: Readings) -> list[FloatArray]:
    """Evaluate a program with numpy, to compare it with the hooks.

    Args:
        program: The program.
        batch: What hooks read in a batch of M environments.

    Returns:
        The results, each of shape (M,); Booleans are 0 and 1.
    """
    rows = {
        "output": batch.values,
        "input": batch.inputs,
        "action": [batch.action.astype(np.float64)],
        "parameter": list(batch.parameters.values()),
        "step_count": [batch.step_count.astype(np.float64)],
        "constant": [np.full(len(batch.step_count), c) for c in program.constants],
    }
    registers: list[FloatArray] = []
    for number, *operands in program.code.tolist():
        operation = OPERATIONS[number]
        if operation in rows:
            registers.append(np.asarray(rows[operation][operands[0]], np.float64))
        else:
            values = [registers[operand] for operand in operands]
            registers.append(np.asarray(_EVALUATIONS[operation](*values), np.float64))
    return [registers[number] for number in program.results.tolist()]


_EVALUATIONS: Final[Mapping[str, Callable[..., Any]]] = {
    "add": lambda a, b, _: a + b,
    "subtract": lambda a, b, _: a - b,
    "multiply": lambda a, b, _: a * b,
    "divide": lambda a, b, _: a / b,
    "negative": lambda a, *_: -a,
    "absolute": lambda a, *_: np.abs(a),
    "square_root": lambda a, *_: np.sqrt(a),
    "minimum": lambda a, b, _: np.minimum(a, b),
    "maximum": lambda a, b, _: np.maximum(a, b),
    "less": lambda a, b, _: a < b,
    "less_equal": lambda a, b, _: a <= b,
    "greater": lambda a, b, _: a > b,
    "greater_equal": lambda a, b, _: a >= b,
    "equal": lambda a, b, _: a == b,
    "not_equal": lambda a, b, _: a != b,
    "and": lambda a, b, _: a * b,
    "or": lambda a, b, _: np.maximum(a, b),
    "not": lambda a, *_: 1.0 - a,
    "where": lambda a, b, c: np.where(a != 0.0, b, c),
}
