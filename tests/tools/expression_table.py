"""The table of the language of expressions: each row with its value in numpy.

``TEXTS`` has what users write, ``OPERATIONS`` what programs compute with each type. Both are
complete: ``tests/expressions/test_expressions.py`` fails if the language has more. A new function
is a new row here.
"""

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

NAMES = {"a": "d", "b": "d", "c": "d", "p": "?", "q": "?"}
"""The names that texts read, and their types: three numbers and two conditions."""


class Row(NamedTuple):
    """A row of the table.

    Attributes:
        wanted: The value in numpy, of the arrays of the operands.
        function: The function of the C library whose last bits may differ from numpy's; "" if
            numpy's value is the only right one.
    """

    wanted: Callable[..., Any]
    function: str = ""


def in_c(name: str, kind: type = ctypes.c_double) -> Callable[..., Any]:
    """A function of the C library for each element of arrays."""

    def of_arrays(*operands):
        function = ctypes.CDLL(None)[name]
        function.argtypes, function.restype = [kind] * len(operands), kind
        lists = (np.atleast_1d(operand).tolist() for operand in operands)
        return np.array([function(*numbers) for numbers in zip(*lists, strict=True)], kind)

    return of_arrays


def pow_of_c(base, exponent):
    """The power of each element by the C library, which numpy also calls for ``float_power``."""
    return in_c("pow")(*np.broadcast_arrays(np.float64(base), np.float64(exponent)))


def powf_of_c(base, exponent):
    """The same of numbers that are rounded to float32."""
    power = in_c("powf", ctypes.c_float)
    return power(base.astype(np.float32), exponent.astype(np.float32)).astype(np.float64)


# What users write. Numpy names the value of each text for arrays of the names.

ARITHMETIC = {
    "+a": Row(lambda a: a),
    "-a": Row(np.negative),
    "a + b": Row(np.add),
    "a - b": Row(np.subtract),
    "a * b": Row(np.multiply),
    "a / b": Row(np.divide),
    "a % b": Row(np.remainder),
    "a ** b": Row(pow_of_c),
    "a ** 2": Row(lambda a: a * a),
    "pi * a": Row(lambda a: np.pi * a),
    "a if p else b": Row(lambda a, b, p: np.where(p, a, b)),
    "p + q": Row(lambda p, q: p * 1.0 + q * 1.0),
    "p * a": Row(lambda a, p: p * 1.0 * a),
}
CONDITIONS = {
    "a < b": Row(np.less),
    "a <= b": Row(np.less_equal),
    "a > b": Row(np.greater),
    "a >= b": Row(np.greater_equal),
    "a == b": Row(np.equal),
    "a != b": Row(np.not_equal),
    "p and q": Row(np.logical_and),
    "p or q": Row(np.logical_or),
    "not p": Row(np.logical_not),
    "p and true": Row(lambda p: p),
    "p or false": Row(lambda p: p),
    "p == q": Row(np.equal),
    "a < b <= c": Row(lambda a, b, c: (a < b) & (b <= c)),
    "a != b > c == a": Row(lambda a, b, c: (a != b) & (b > c) & (c == a)),
    "p if a < b else q": Row(lambda a, b, p, q: np.where(a < b, p, q)),
}
FUNCTIONS = {
    "abs(a)": Row(np.abs),
    "min(a, b)": Row(np.minimum),
    "min(a, b, c)": Row(lambda a, b, c: np.minimum(np.minimum(a, b), c)),
    "max(a, b)": Row(np.maximum),
    "max(a, b, c)": Row(lambda a, b, c: np.maximum(np.maximum(a, b), c)),
    "clip(a, b, c)": Row(lambda a, b, c: np.minimum(np.maximum(a, b), c)),
    "sign(a)": Row(np.sign),
    "floor(a)": Row(np.floor),
    "ceil(a)": Row(np.ceil),
    "round(a)": Row(np.rint),
    "float32(a)": Row(lambda a: a.astype(np.float32).astype(np.float64)),
    "sqrt(a)": Row(np.sqrt),
    "square(a)": Row(np.square),
    "radians(a)": Row(np.radians),
    "degrees(a)": Row(np.degrees),
    "pow(a, b)": Row(pow_of_c),
    "pow(a, 2)": Row(lambda a: pow_of_c(a, 2.0)),
    "powf(a, b)": Row(powf_of_c),
    "powf(a, 2)": Row(lambda a: powf_of_c(a, np.full_like(a, 2.0))),
    "exp(a)": Row(np.exp, "exp"),
    "expm1(a)": Row(np.expm1, "expm1"),
    "log(a)": Row(np.log, "log"),
    "log10(a)": Row(np.log10, "log10"),
    "log1p(a)": Row(np.log1p, "log1p"),
    "hypot(a, b)": Row(np.hypot, "hypot"),
    "sin(a)": Row(np.sin, "sin"),
    "cos(a)": Row(np.cos, "cos"),
    "tan(a)": Row(np.tan, "tan"),
    "arcsin(a)": Row(np.arcsin, "asin"),
    "arccos(a)": Row(np.arccos, "acos"),
    "arctan(a)": Row(np.arctan, "atan"),
    "arctan2(a, b)": Row(np.arctan2, "atan2"),
    "sinh(a)": Row(np.sinh, "sinh"),
    "cosh(a)": Row(np.cosh, "cosh"),
    "tanh(a)": Row(np.tanh, "tanh"),
}
TEXTS = ARITHMETIC | CONDITIONS | FUNCTIONS

NOT_IN_THE_LANGUAGE = ("a // b", "a @ b", "a & b", "a | b", "a ^ b", "a << b", "a >> b", "~a")
NOT_IN_THE_LANGUAGE += ("a is b", "a is not b", "a in b", "a not in b")
"""The operators of Python that expressions do not have."""


# What programs compute. A name of numpy and a letter for each type, as ``OPERATIONS`` has them.


class Operation(NamedTuple):
    """A function of numpy that programs compute.

    Attributes:
        letters: The types of its operands.
        function: As that of a ``Row``, for float64.
    """

    letters: str
    function: str = ""


UFUNCS = {
    np.add: Operation("dfq"),
    np.subtract: Operation("dfq"),
    np.multiply: Operation("dfq"),
    np.negative: Operation("dfq"),
    np.minimum: Operation("dfq?"),
    np.maximum: Operation("dfq?"),
    np.less: Operation("dfq"),
    np.less_equal: Operation("dfq"),
    np.greater: Operation("dfq"),
    np.greater_equal: Operation("dfq"),
    np.equal: Operation("dfq"),
    np.not_equal: Operation("dfq?"),
    np.divide: Operation("df"),
    np.absolute: Operation("df"),
    np.sqrt: Operation("df"),
    np.floor: Operation("d"),
    np.ceil: Operation("d"),
    np.trunc: Operation("d"),
    np.rint: Operation("d"),
    np.bitwise_and: Operation("q?"),
    np.bitwise_xor: Operation("q?"),
    np.right_shift: Operation("q"),
    np.bitwise_or: Operation("?"),
    np.logical_not: Operation("?"),
    np.remainder: Operation("dq"),
    np.floor_divide: Operation("dq"),
    np.fmod: Operation("d"),
    np.copysign: Operation("d"),
    np.float_power: Operation("d", "pow"),
    np.power: Operation("f", "powf"),
    np.sin: Operation("d", "sin"),
    np.cos: Operation("d", "cos"),
    np.tan: Operation("d", "tan"),
    np.sinh: Operation("d", "sinh"),
    np.cosh: Operation("d", "cosh"),
    np.tanh: Operation("d", "tanh"),
    np.exp: Operation("d", "exp"),
    np.exp2: Operation("d", "exp2"),
    np.expm1: Operation("d", "expm1"),
    np.log: Operation("d", "log"),
    np.log2: Operation("d", "log2"),
    np.log10: Operation("d", "log10"),
    np.log1p: Operation("d", "log1p"),
    np.cbrt: Operation("d", "cbrt"),
    np.hypot: Operation("d", "hypot"),
    np.arcsin: Operation("d", "asin"),
    np.arccos: Operation("d", "acos"),
    np.arctan: Operation("d", "atan"),
    np.arctan2: Operation("d", "atan2"),
    np.arcsinh: Operation("d", "asinh"),
    np.arccosh: Operation("d", "acosh"),
    np.arctanh: Operation("d", "atanh"),
}
OPERATIONS = {
    f"{ufunc.__name__} {letter}": (ufunc, letter)
    for ufunc, row in UFUNCS.items()
    for letter in row.letters
}
"""Each function with each type of its operands."""


# Numbers

SPECIAL = [
    *(0.0, -0.0, np.inf, -np.inf, np.nan, 5e-324, -5e-324, 2.2e-308, -1e-310, 1e-160, -1e-300),
    *(0.5, -0.5, 1.0, -1.0, 2.0, -2.5, 3.0, 30.0, -7.0, np.pi, -np.pi / 2, 2.0**53 + 1.0),
    *(1e15, -(2.0**31), 1.3e154, 1e300, -1.7e308, 3.5e38),
]
"""Zeros of both signs, infinities, no number, denormals, and what is very small or very great."""


def numbers(letter: str) -> list[np.ndarray]:
    """Three arrays of operands of a type, in which special numbers meet each other."""
    rng = np.random.default_rng(0)
    if letter == "?":
        return list(rng.random((3, 200)) < 0.5)
    if letter in "qb":
        limits = np.iinfo(letter)
        few = np.array([limits.min, limits.max, -7, -1, 0, 1, 3, 63, 64, limits.max // 2])
        many = rng.integers(-99, 99, 107)
    else:
        few = np.array(SPECIAL)
        many = rng.normal(size=500) * 10.0 ** rng.uniform(-20, 20, 500)
        many = np.concatenate([many, rng.uniform(-8.0, 8.0, 507), rng.integers(-9, 9, 200) / 4])
    first, second = (part.ravel() for part in np.meshgrid(few, few))
    order = rng.permutation(len(first) + len(many))
    first = np.concatenate([first, many])[order]
    second = np.concatenate([second, rng.permutation(many)])[order]
    with np.errstate(over="ignore"):
        return [one.astype(letter) for one in (first, second, rng.permutation(first))]


def operands(dtypes: str) -> list[np.ndarray]:
    """Arrays of the same length for operands of some types."""
    found = [numbers(letter)[place % 3] for place, letter in enumerate(dtypes)]
    return [np.resize(one, max(map(len, found))) for one in found]
