"""The functions of expressions, for numbers, arrays and symbols.

In Python all of them give one number the same value, to the last bit, as an element of an array:
they are numpy's functions, or operators that IEEE 754 settles.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, Final, NamedTuple

import numpy as np

__all__ = ["FUNCTIONS", "OPERATIONS", "Function"]


class Function(NamedTuple):
    """A function that expressions may call.

    Attributes:
        call: The function.
        fewest, most: How many arguments it takes; None for any number.
    """

    call: Callable[..., Any]
    fewest: int = 1
    most: int | None = 1


def _divide(first: Any, second: Any) -> Any:
    try:
        return first / second
    except ZeroDivisionError:  # Python's floats raise where numpy gives an infinity or NaN
        return np.divide(first, second)


def _remainder(first: Any, second: Any) -> Any:
    try:
        return first % second
    except ZeroDivisionError:
        return np.remainder(first, second)


def _power(base: Any, exponent: Any) -> Any:
    if isinstance(exponent, float) and exponent == 2.0:  # a product takes far less time
        return np.square(base, dtype=np.float64)
    return np.float_power(base, exponent)


def _where(condition: Any, first: Any, second: Any) -> Any:
    if isinstance(condition, bool | np.bool_):
        return np.float64(first if condition else second)  # the type that numpy.where gives
    chosen = np.where(condition, first, second)
    return chosen if chosen.ndim else chosen[()]  # a number if all are numbers


def _clip(value: Any, low: Any, high: Any) -> Any:
    return np.minimum(np.maximum(value, low), high)


def _float32(value: Any) -> Any:
    """Round to the nearest number that a float32 can hold."""
    return np.positive(np.positive(value, dtype=np.float32), dtype=np.float64)


def _float64(value: Any) -> Any:
    return np.positive(value, dtype=np.float64)


def _take(table: Any, index: Any) -> Any:
    if isinstance(index, int | np.integer):
        return float(table[index])
    return np.take(table, index)  # looked up in each call: it is replaced while hooks are traced


_STEP: Final = np.int64(0x9E3779B97F4A7C15 - 2**64)
_FIRST: Final = np.int64(0xBF58476D1CE4E5B9 - 2**64)
_SECOND: Final = np.int64(0x94D049BB133111EB - 2**64)
"""The constants of SplitMix64: Steele, Lea and Flood, "Fast Splittable Pseudorandom Number
Generators" (2014). Products and sums of int64 wrap around to the same bits as without a sign."""

_FRACTION: Final = 2.0**-53


def _shifted(word: Any, bits: int) -> Any:
    """Move bits to the right; zeros follow, and not the sign."""
    return (word >> np.int64(bits)) & np.int64(2 ** (64 - bits) - 1)


def _mixed(word: Any) -> Any:
    """Mix 64 bits as SplitMix64 does."""
    word = (word ^ _shifted(word, 30)) * _FIRST
    word = (word ^ _shifted(word, 27)) * _SECOND
    return word ^ _shifted(word, 31)


def _word(key: Any, count: Any, channel: int) -> Any:
    """64 random bits that are a function of the arguments; see ``_noise``."""
    episode = _mixed(np.asarray(key).astype(np.int64) + _STEP)
    return _mixed(episode + np.asarray(count).astype(np.int64) * _STEP + np.int64(channel))


def _fraction(word: Any) -> Any:
    """A number from 0 to 1, without 1, of 64 bits."""
    return _shifted(word, 11) * _FRACTION


def _chance(key: Any, count: Any, channel: int) -> Any:
    """A number of the uniform distribution from 0 to 1; see ``_noise``."""
    return _fraction(_mixed(_word(key, count, channel) + _STEP))


def _noise(key: Any, count: Any, channel: int) -> Any:
    """A number of the standard normal distribution, by the method of Box and Muller.

    It is a function of its arguments, and so needs no generator.

    Args:
        key: A whole number below 2**53 for each episode.
        count: A whole number, such as that of the step.
        channel: The number of the sensor.
    """
    word = _word(key, count, channel)
    first = _fraction(_mixed(word + _STEP)) + _FRACTION  # the logarithm of 0 is not finite
    second = _fraction(_mixed(word + _STEP + _STEP))
    return np.sqrt(-2.0 * np.log(first)) * np.cos(2.0 * np.pi * second)


def _minimum(*values: Any) -> Any:
    return reduce(np.minimum, values)


def _maximum(*values: Any) -> Any:
    return reduce(np.maximum, values)


OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    "divide": _divide,
    "remainder": _remainder,
    "power": _power,
    "where": _where,
    "float64": _float64,
    "take": _take,
    "noise": _noise,
    "chance": _chance,
}
"""What the code of expressions calls for operators and for values that it looks up."""

_OF_NUMPY: Final = (
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh"),
    *("exp", "expm1", "log", "log10", "log1p", "sqrt", "square", "sign", "floor", "ceil"),
    *("radians", "degrees"),
)

FUNCTIONS: Final[dict[str, Function]] = {
    "abs": Function(abs),
    "min": Function(_minimum, 2, None),
    "max": Function(_maximum, 2, None),
    "clip": Function(_clip, 3, 3),
    "hypot": Function(np.hypot, 2, 2),
    "arctan2": Function(np.arctan2, 2, 2),
    "round": Function(np.rint),
    "float32": Function(_float32),
    **{name: Function(getattr(np, name)) for name in _OF_NUMPY},
}
"""The functions by the names that they have in expressions."""
