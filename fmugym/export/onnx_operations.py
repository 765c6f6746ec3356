"""The operations of traced hooks as nodes of ONNX.

Where ONNX Runtime has a function in float32 only, or not at all, it is composed of others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from fmugym.errors import ConfigError
from fmugym.export.onnx_nodes import Nodes

__all__ = ["computed", "interpolated"]

_SAME: Final[Mapping[Any, str]] = {
    np.add: "Add",
    np.subtract: "Sub",
    np.multiply: "Mul",
    np.divide: "Div",
    np.less: "Less",
    np.less_equal: "LessOrEqual",
    np.equal: "Equal",
    np.greater: "Greater",
    np.greater_equal: "GreaterOrEqual",
    np.minimum: "Min",
    np.maximum: "Max",
    np.power: "Pow",
    np.float_power: "Pow",
    np.absolute: "Abs",
    np.negative: "Neg",
    np.sqrt: "Sqrt",
    np.exp: "Exp",
    np.log: "Log",
    np.sin: "Sin",
    np.cos: "Cos",
    np.tanh: "Tanh",
    np.floor: "Floor",
    np.ceil: "Ceil",
    np.rint: "Round",
}
"""Functions that ONNX has, for the same types of operands."""

_OF_FLAGS: Final[Mapping[Any, str]] = {
    np.logical_and: "And",
    np.bitwise_and: "And",
    np.multiply: "And",
    np.logical_or: "Or",
    np.bitwise_or: "Or",
    np.add: "Or",
    np.logical_xor: "Xor",
    np.bitwise_xor: "Xor",
    np.not_equal: "Xor",
    np.logical_not: "Not",
    np.invert: "Not",
}

_ANGLES: Final[Mapping[Any, str]] = {np.arcsin: "Asin", np.arccos: "Acos", np.arctan: "Atan"}
"""Functions that ONNX Runtime computes with float32 only."""


def computed(nodes: Nodes, ufunc: Any, operands: Sequence[str], dtype: np.dtype[Any]) -> str:
    """A function of numpy as nodes.

    Args:
        nodes: Takes the nodes.
        ufunc: The function.
        operands: The names of its operands.
        dtype: The type of these.

    Returns:
        The name of the result.

    Raises:
        ConfigError: If it cannot be written.
    """
    if dtype == np.bool_ and ufunc in _OF_FLAGS:
        return nodes.add(_OF_FLAGS[ufunc], *operands)
    if ufunc in _SAME and dtype != np.bool_:
        return nodes.add(_SAME[ufunc], *operands)
    if ufunc in _COMPOSED and dtype != np.bool_:
        return _COMPOSED[ufunc](nodes, dtype, *operands)
    if ufunc in _ANGLES and dtype.kind == "f":
        narrow = nodes.cast(operands[0], np.dtype(np.float32))
        return nodes.cast(nodes.add(_ANGLES[ufunc], narrow), dtype)
    raise ConfigError(f"numpy.{ufunc.__name__} of type {dtype} cannot be exported to ONNX")


def _remainder(nodes: Nodes, dtype: np.dtype[Any], a: str, b: str) -> str:
    """The remainder with the sign of the divisor."""
    if dtype.kind != "f":
        return nodes.add("Mod", a, b)
    rest, zero = nodes.add("Mod", a, b, fmod=1), nodes.constant(0.0, dtype)
    differs = nodes.add("Xor", nodes.add("Less", rest, zero), nodes.add("Less", b, zero))
    moves = nodes.add("And", nodes.add("Not", nodes.add("Equal", rest, zero)), differs)
    return nodes.add("Where", moves, nodes.add("Add", rest, b), rest)


def _floor_divide(nodes: Nodes, dtype: np.dtype[Any], a: str, b: str) -> str:
    rest = nodes.add("Sub", a, _remainder(nodes, dtype, a, b))
    quotient = nodes.add("Div", rest, b)
    return nodes.add("Round", quotient) if dtype.kind == "f" else quotient


def _of_exponentials(sign: str) -> Callable[..., str]:
    """The hyperbolic sine or cosine."""

    def compose(nodes: Nodes, dtype: np.dtype[Any], x: str) -> str:
        parts = nodes.add("Exp", x), nodes.add("Exp", nodes.add("Neg", x))
        return nodes.add("Mul", nodes.add(sign, *parts), nodes.constant(0.5, dtype))

    return compose


def _log_of(make: Callable[[Nodes, str, str], str], factor: float = 1.0) -> Callable[..., str]:
    """A factor times the logarithm of something made of the operand and 1."""

    def compose(nodes: Nodes, dtype: np.dtype[Any], x: str) -> str:
        log = nodes.add("Log", make(nodes, x, nodes.constant(1.0, dtype)))
        return log if factor == 1.0 else nodes.add("Mul", log, nodes.constant(factor, dtype))

    return compose


def _root(nodes: Nodes, x: str, one: str, sign: str) -> str:
    """X plus the root of x squared plus or minus 1."""
    inner = nodes.add(sign, nodes.add("Mul", x, x), one)
    return nodes.add("Add", x, nodes.add("Sqrt", inner))


def _ratio(nodes: Nodes, x: str, one: str) -> str:
    return nodes.add("Div", nodes.add("Add", one, x), nodes.add("Sub", one, x))


def _hypot(nodes: Nodes, dtype: np.dtype[Any], a: str, b: str) -> str:
    return nodes.add("Sqrt", nodes.add("Add", nodes.add("Mul", a, a), nodes.add("Mul", b, b)))


def _arctan2(nodes: Nodes, dtype: np.dtype[Any], y: str, x: str) -> str:
    """2 atan(y / (r + x)), and pi on the negative axis."""
    length = _hypot(nodes, dtype, x, y)
    below = nodes.add("Add", length, x)
    is_axis = nodes.add("Equal", below, nodes.constant(0.0, dtype))
    safe = nodes.add("Where", is_axis, nodes.constant(1.0, dtype), below)
    half = computed(nodes, np.arctan, [nodes.add("Div", y, safe)], dtype)
    angle = nodes.add("Mul", half, nodes.constant(2.0, dtype))
    is_zero = nodes.add("Equal", length, nodes.constant(0.0, dtype))
    end = nodes.add("Where", is_zero, nodes.constant(0.0, dtype), nodes.constant(math.pi, dtype))
    return nodes.add("Where", is_axis, end, angle)


_COMPOSED: Final[Mapping[Any, Callable[..., str]]] = {
    np.not_equal: lambda nodes, dtype, a, b: nodes.add("Not", nodes.add("Equal", a, b)),
    np.remainder: _remainder,
    np.floor_divide: _floor_divide,
    np.fmod: lambda nodes, dtype, a, b: nodes.add("Mod", a, b, fmod=1),
    np.hypot: _hypot,
    np.arctan2: _arctan2,
    np.tan: lambda nodes, dtype, x: nodes.add("Div", nodes.add("Sin", x), nodes.add("Cos", x)),
    np.sinh: _of_exponentials("Sub"),
    np.cosh: _of_exponentials("Add"),
    np.arcsinh: _log_of(lambda nodes, x, one: _root(nodes, x, one, "Add")),
    np.arccosh: _log_of(lambda nodes, x, one: _root(nodes, x, one, "Sub")),
    np.arctanh: _log_of(_ratio, 0.5),
    np.log1p: _log_of(lambda nodes, x, one: nodes.add("Add", x, one)),
    np.log2: _log_of(lambda nodes, x, one: x, 1 / math.log(2)),
    np.log10: _log_of(lambda nodes, x, one: x, 1 / math.log(10)),
    np.expm1: lambda nodes, dtype, x: nodes.add(
        "Sub", nodes.add("Exp", x), nodes.constant(1.0, dtype)
    ),
    np.exp2: lambda nodes, dtype, x: nodes.add("Pow", nodes.constant(2.0, dtype), x),
}


def interpolated(nodes: Nodes, x: str, table: Any) -> str:
    """A value between those of a table, as ``numpy.interp`` finds it.

    Args:
        nodes: Takes the nodes.
        x: Where to look.
        table: The arguments, the values, and the values before the first and after the last.
    """
    count = len(table) // 2 - 1
    names = [nodes.tensor(part) for part in (table[:count], table[count : 2 * count])]
    place = _place(nodes, x, names[0], count)
    (low, high), (first, last) = (_neighbours(nodes, name, place) for name in names)
    width = nodes.add("Sub", high, low)
    is_end = nodes.add("Equal", width, nodes.constant(0.0, table.dtype))  # both are the last one
    safe = nodes.add("Where", is_end, nodes.constant(1.0, table.dtype), width)
    slope = nodes.add("Div", nodes.add("Sub", last, first), safe)
    inside = nodes.add("Add", nodes.add("Mul", slope, nodes.add("Sub", x, low)), first)
    for operation, edge, value in (("Less", 0, -2), ("Greater", count - 1, -1)):
        outside = nodes.add(operation, x, nodes.constant(table[edge], table.dtype))
        other = nodes.constant(table[value], table.dtype)
        inside = nodes.add("Where", outside, other, inside)
    return inside


def _place(nodes: Nodes, x: str, arguments: str, count: int) -> str:
    """The number of the last argument that is not above x."""
    column = nodes.add("Unsqueeze", x, nodes.tensor(np.array([-1])))
    reached = nodes.cast(nodes.add("GreaterOrEqual", column, arguments), np.dtype(np.int64))
    axis = nodes.tensor(np.array([-1]))
    number = nodes.add("ReduceSum", reached, axis, keepdims=0)
    place = nodes.add("Sub", number, nodes.constant(1, np.dtype(np.int64)))
    return nodes.add("Max", place, nodes.constant(0, np.dtype(np.int64)))


def _neighbours(nodes: Nodes, values: str, place: str) -> tuple[str, str]:
    whole = np.dtype(np.int64)
    following = nodes.add("Add", place, nodes.constant(1, whole))
    last = nodes.constant(nodes.length(values) - 1, whole)
    later = nodes.add("Min", following, last)
    return nodes.add("Gather", values, place), nodes.add("Gather", values, later)
