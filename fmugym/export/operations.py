"""The operations of traced hooks as expressions in C."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from fmugym.errors import ConfigError

__all__ = ["HELPERS", "TYPES", "constant", "expression"]

TYPES: Final[Mapping[str, str]] = {
    "d": "double",
    "f": "float",
    "?": "bool",
    "q": "int64_t",
    "l": "int64_t",
}
"""C's types by numpy's letters."""

_INFIX: Final[Mapping[Any, str]] = {
    np.add: "+",
    np.subtract: "-",
    np.multiply: "*",
    np.divide: "/",
    np.less: "<",
    np.less_equal: "<=",
    np.greater: ">",
    np.greater_equal: ">=",
    np.equal: "==",
    np.not_equal: "!=",
    np.logical_and: "&&",
    np.logical_or: "||",
}
_OF_BOOLEANS: Final[Mapping[Any, str]] = {
    np.bitwise_and: "&&",
    np.bitwise_or: "||",
    np.bitwise_xor: "!=",
    np.logical_xor: "!=",
    np.add: "||",
    np.multiply: "&&",
}
_OF_INTEGERS: Final[Mapping[Any, str]] = {
    np.bitwise_and: "&",
    np.bitwise_xor: "^",
    np.right_shift: ">>",
}

_OF_MATH: Final[Mapping[Any, str]] = {
    **{getattr(np, name): name for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "hypot")},
    **{getattr(np, name): name for name in ("exp", "exp2", "expm1", "log", "log2", "log10")},
    **{getattr(np, name): name for name in ("log1p", "sqrt", "cbrt", "floor", "ceil", "trunc")},
    np.rint: "rint",
    np.fmod: "fmod",
    np.copysign: "copysign",
    np.arcsin: "asin",
    np.arccos: "acos",
    np.arctan: "atan",
    np.arctan2: "atan2",
    np.arcsinh: "asinh",
    np.arccosh: "acosh",
    np.arctanh: "atanh",
    np.power: "pow",
    np.float_power: "pow",
    np.absolute: "fabs",
}
"""Functions of the C library for numbers of floating point."""


_OWN: Final[Mapping[Any, str]] = {
    np.minimum: "minimum",
    np.maximum: "maximum",
    np.remainder: "remainder",
    np.floor_divide: "floor_divide",
}

HELPERS: Final[Mapping[str, str]] = {
    "minimum": "{T} {name}({T} a, {T} b) {{\n    return (a < b || a != a) ? a : b;\n}}",
    "maximum": "{T} {name}({T} a, {T} b) {{\n    return (a > b || a != a) ? a : b;\n}}",
    "remainder": (
        "{T} {name}({T} a, {T} b) {{\n    const {T} r = fmod{f}(a, b);\n"
        "    if (r == 0) {{\n        return copysign{f}(0, b);\n    }}\n"
        "    return ((r < 0) != (b < 0)) ? r + b : r;\n}}"
    ),
    "floor_divide": (
        "{T} {name}({T} a, {T} b) {{\n    const {T} r = fmod{f}(a, b);\n"
        "    const {T} q = (a - r) / b - ((r != 0 && (r < 0) != (b < 0)) ? 1 : 0);\n"
        "    const {T} whole = floor{f}(q);\n    return (q - whole > 0.5) ? whole + 1 : whole;\n}}"
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
"""Functions that the C library lacks, as numpy computes them. ``f`` is its suffix for the type."""


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
        return f"(-({TYPES[letter]}){text})" if value < 0 else f"(({TYPES[letter]}){text})"
    text = str(np.float32(value)) if letter == "f" else repr(float(value))
    text = text if "." in text or "e" in text else f"{text}.0"
    text += "f" if letter == "f" else ""
    return f"({text})" if text.startswith("-") else text


def expression(ufunc: Any, operands: Sequence[str], letters: str, use: Any) -> str:
    """A function of numpy as an expression.

    Args:
        ufunc: The function.
        operands: The expressions of its operands, in parentheses where needed.
        letters: Their types.
        use: A function that notes a helper, for a letter, and returns its name.

    Raises:
        ConfigError: If it cannot be written.
    """
    kind = letters[0]
    infix = (_OF_BOOLEANS if kind == "?" else _OF_INTEGERS if kind not in "df" else {}).get(ufunc)
    infix = infix or (None if kind == "?" and ufunc is np.subtract else _INFIX.get(ufunc))
    if infix is not None:
        return f"({operands[0]} {infix} {operands[1]})"
    if kind in "df":
        text = _of_floats(ufunc, operands, kind, use)
    else:
        text = _of_whole_numbers(ufunc, operands, kind, use)
    if text is None:
        raise ConfigError(f"numpy.{ufunc.__name__} of type {np.dtype(kind)} cannot be exported")
    return text


def _of_floats(ufunc: Any, operands: Sequence[str], kind: str, use: Any) -> str | None:
    arguments = ", ".join(operands)
    if ufunc in _OWN:
        return f"{use(_OWN[ufunc], kind)}({arguments})"
    if ufunc in _OF_MATH:
        return f"{_OF_MATH[ufunc]}{'f' if kind == 'f' else ''}({arguments})"
    return f"(-{operands[0]})" if ufunc is np.negative else None


def _of_whole_numbers(ufunc: Any, operands: Sequence[str], kind: str, use: Any) -> str | None:
    first = operands[0]
    if kind == "?":
        return f"(!{first})" if ufunc in {np.logical_not, np.invert} else None
    if ufunc in {np.minimum, np.maximum}:
        return f"{use(_OWN[ufunc], kind)}({', '.join(operands)})"
    return f"(-{first})" if ufunc is np.negative else None
