"""Programs: hooks in the form that the native pool runs.

A program is a list of instructions on registers. The native pool runs it in the same pass as the
FMU's step; ``evaluate`` runs it with numpy, so that the two can be compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.pool.base import FloatArray
from fmugym.pool.extension import has_native_pool

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

    What a program loads is finite: the pool does not step with inputs that are not, and an FMU
    whose outputs are not has failed. Only arithmetic may overflow, or divide by zero.
    """
    finite: list[bool] = []
    for number, *operands in program.code.tolist():
        operation = OPERATIONS[number]
        if operation == "constant":
            finite.append(math.isfinite(program.constants[operands[0]]))
        elif operation in _CHOICES:
            used = operands[1:] if operation == "where" else operands[:2]
            finite.append(all(finite[operand] for operand in used))
        else:
            finite.append(operation not in _MAY_OVERFLOW)
    return finite[int(program.results[result])]


_CHOICES: Final = frozenset({"absolute", "maximum", "minimum", "negative", "where"})
"""Operations whose result is finite if their operands are."""

_MAY_OVERFLOW: Final = frozenset({"add", "subtract", "multiply", "divide", "square_root"})


def evaluate(program: Program, batch: FMUEnv) -> list[FloatArray]:
    """Evaluate a program with numpy, to compare it with the hooks.

    Args:
        program: The program.
        batch: An environment whose attributes hold arrays of M environments.

    Returns:
        The results, each of shape (M,); Booleans are 0 and 1.
    """
    rows = {
        "output": batch._values,
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
