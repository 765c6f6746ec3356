"""Mathematical functions of expressions, and functions such as random numbers."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, Final, NamedTuple

import numpy as np

__all__ = [
    "FUNCTIONS",
    "Function",
    "chance",
    "clip",
    "maximum",
    "minimum",
    "noise",
    "splitmix64",
]


class Function(NamedTuple):
    """A function that expressions may call.

    Attributes:
        call: Returns the value for some values; see ``fmugym.expressions.graph``.
        fewest, most: How many arguments it takes; None for any number.
    """

    call: Callable[..., Any]
    fewest: int = 1
    most: int | None = 1


_STEP: Final = np.int64(0x9E3779B97F4A7C15 - 2**64)
_FIRST: Final = np.int64(0xBF58476D1CE4E5B9 - 2**64)
_SECOND: Final = np.int64(0x94D049BB133111EB - 2**64)
"""The constants of SplitMix64: Steele, Lea and Flood, "Fast Splittable Pseudorandom Number
Generators" (2014). Products and sums of int64 wrap around to the same bits as without a sign."""

_FRACTION: Final = 2.0**-53


def _shifted(word: Any, bits: int) -> Any:
    """Move bits to the right; zeros follow, and not the sign."""
    return (word >> np.int64(bits)) & np.int64(2 ** (64 - bits) - 1)


def splitmix64(word: Any) -> Any:
    """64 random bits that SplitMix64 makes of its state, 64 bits."""
    word = (word ^ _shifted(word, 30)) * _FIRST
    word = (word ^ _shifted(word, 27)) * _SECOND
    return word ^ _shifted(word, 31)


def _word(key: Any, count: Any, channel: int) -> Any:
    """64 random bits that are a function of the arguments; see ``noise``."""
    episode = splitmix64(key.cast(np.int64) + _STEP)
    return splitmix64(episode + count.cast(np.int64) * _STEP + np.int64(channel))


def _fraction(word: Any) -> Any:
    """A number from 0 to 1, without 1, of 64 bits."""
    return _shifted(word, 11) * _FRACTION


def chance(key: Any, count: Any, channel: int) -> Any:
    """A number of the uniform distribution from 0 to 1; see ``noise``."""
    return _fraction(splitmix64(_word(key, count, channel) + _STEP))


def noise(key: Any, count: Any, channel: int) -> Any:
    """A number of the standard normal distribution, by the method of Box and Muller.

    It is a function of its arguments, and so needs no generator.

    Args:
        key: A whole number below 2**53 for each episode.
        count: A whole number, such as that of the step.
        channel: The number of the sensor.
    """
    word = _word(key, count, channel)
    first = _fraction(splitmix64(word + _STEP)) + _FRACTION  # the logarithm of 0 is not finite
    second = _fraction(splitmix64(word + _STEP + _STEP))
    return np.sqrt(-2.0 * np.log(first)) * np.cos(2.0 * np.pi * second)


def clip(value: Any, low: Any, high: Any) -> Any:
    """The number of a range that is nearest."""
    return np.minimum(np.maximum(value, low), high)


def minimum(*values: Any) -> Any:
    """The lowest of some numbers."""
    return reduce(np.minimum, values)


def maximum(*values: Any) -> Any:
    """The highest of some numbers."""
    return reduce(np.maximum, values)


def _as_float32(value: Any) -> Any:
    """The nearest number that a float32 can hold."""
    return value.cast(np.float32).cast(np.float64)


def _power_of_float32(base: Any, exponent: Any) -> Any:
    """The power of two numbers that are rounded to float32, as the C function ``powf``."""
    power = np.power(base.cast(np.float32), exponent.cast(np.float32))
    return power.cast(np.float64)


_OF_NUMPY: Final = (
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh"),
    *("exp", "expm1", "log", "log10", "log1p", "sqrt", "square", "sign", "floor", "ceil"),
    *("radians", "degrees"),
)

FUNCTIONS: Final[dict[str, Function]] = {
    "abs": Function(np.absolute),
    "min": Function(minimum, 2, None),
    "max": Function(maximum, 2, None),
    "clip": Function(clip, 3, 3),
    "hypot": Function(np.hypot, 2, 2),
    "arctan2": Function(np.arctan2, 2, 2),
    "round": Function(np.rint),
    "float32": Function(_as_float32),
    "pow": Function(np.float_power, 2, 2),
    "powf": Function(_power_of_float32, 2, 2),
    **{name: Function(getattr(np, name)) for name in _OF_NUMPY},
}
"""The functions by the names that they have in expressions."""
