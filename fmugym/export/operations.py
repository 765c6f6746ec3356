"""The operations of graphs as expressions in C."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from fmugym.errors import ConfigError
from fmugym.expressions.program import letter_of, operation_of

__all__ = ["C_TYPES", "HELPERS", "constant", "expression"]

C_TYPES: Final[Mapping[str, str]] = {
    "d": "double",
    "f": "float",
    "?": "bool",
    "q": "int64_t",
    "l": "int64_t",
}
"""C's types by numpy's letters."""

_INFIX: Final[Mapping[str, str]] = {
    "add": "+",
    "subtract": "-",
    "multiply": "*",
    "divide": "/",
    "less": "<",
    "less_equal": "<=",
    "greater": ">",
    "greater_equal": ">=",
    "equal": "==",
    "not_equal": "!=",
    "and": "&&",
    "or": "||",
    "xor": "!=",
    "bitwise_and": "&",
    "bitwise_xor": "^",
    "right_shift": ">>",
}
_PREFIX: Final[Mapping[str, str]] = {"negative": "-", "not": "!"}

_OF_MATH: Final[Mapping[str, str]] = {"power": "pow", "absolute": "fabs"}
"""Functions of the C library whose names differ from numpy's by more than ``arc``."""

HELPERS: Final[Mapping[str, str]] = {
    "minimum": "{T} {name}({T} a, {T} b) {{\n    return (a < b || a != a) ? a : b;\n}}",
    "maximum": "{T} {name}({T} a, {T} b) {{\n    return (a > b || a != a) ? a : b;\n}}",
    "remainder": (
        "{T} {name}({T} a, {T} b) {{\n    const {T} r = fmod(a, b);\n"
        "    if (r == 0) {{\n        return copysign(0, b);\n    }}\n"
        "    return ((r < 0) != (b < 0)) ? r + b : r;\n}}"
    ),
    "floor_divide": (
        "{T} {name}({T} a, {T} b) {{\n    const {T} r = fmod(a, b);\n"
        "    const {T} q = (a - r) / b - ((r != 0 && (r < 0) != (b < 0)) ? 1 : 0);\n"
        "    const {T} whole = floor(q);\n    return (q - whole > 0.5) ? whole + 1 : whole;\n}}"
    ),
    "interpolate": (
        "{T} {name}({T} x, const {T} *xs, const {T} *ys, int count) {{\n"
        "    int low = 0, high = count - 1;\n"
        "    if (!(x >= xs[0])) {{\n        return (x != x) ? x : ys[count];\n    }}\n"
        "    if (x > xs[high]) {{\n        return ys[count + 1];\n    }}\n"
        "    while (high - low > 1) {{\n        const int middle = low + (high - low) / 2;\n"
        "        if (x < xs[middle]) {{\n            high = middle;\n        }} else {{\n"
        "            low = middle;\n        }}\n    }}\n"
        "    if (x >= xs[high]) {{\n        return ys[high];\n    }}\n"
        "    return (ys[high] - ys[low]) / (xs[high] - xs[low]) * (x - xs[low]) + ys[low];\n}}"
    ),
}
"""Functions that the C library lacks, as numpy computes them."""


def constant(value: Any, letter: str) -> str:
    """A number as C writes it; reading it gives the same number."""
    if letter in "df":
        return _float(value, letter)
    if letter == "?":
        return "true" if value else "false"
    number = int(value)
    if number == -(2**63):  # C has no literal of it
        return f"({constant(number + 1, letter)} - 1)"
    text = str(number) if abs(number) < 2**31 else f"INT64_C({number})"
    return text if number >= 0 else f"({text})"


def _float(value: Any, letter: str) -> str:
    if not np.isfinite(value):
        text = "NAN" if np.isnan(value) else "INFINITY"
        return f"(-({C_TYPES[letter]}){text})" if value < 0 else f"(({C_TYPES[letter]}){text})"
    text = str(np.float32(value)) if letter == "f" else repr(float(value))
    text = text if "." in text or "e" in text else f"{text}.0"
    text += "f" if letter == "f" else ""
    return f"({text})" if text.startswith("-") else text


def expression(
    ufunc: Any, operands: Sequence[str], dtype: np.dtype[Any], use: Callable[[str, str], str]
) -> str:
    """A function of numpy as an expression.

    Args:
        ufunc: A function that programs have for this type, see ``operation_of``.
        operands: The expressions of its operands, in parentheses where needed.
        dtype: Their type.
        use: A function that notes a helper, for a letter, and returns its name.

    Raises:
        ConfigError: If it cannot be written.
    """
    letter = letter_of(dtype)
    name, *_ = str(operation_of(ufunc, letter)).split()
    if name in _INFIX:
        return f"({operands[0]} {_INFIX[name]} {operands[1]})"
    if name in _PREFIX:
        return f"({_PREFIX[name]}{operands[0]})"
    if letter == "q" and name not in {"minimum", "maximum"}:
        raise ConfigError(f"numpy.{name} of type {dtype} cannot be exported to C")
    if name in HELPERS:
        function = use(name, letter)
    else:
        suffix = "f" if letter == "f" else ""
        function = _OF_MATH.get(name, name.replace("arc", "a")) + suffix
    return f"{function}({', '.join(operands)})"
