"""Numbers in the place of the texts that Strings start with.

Between the draws and an FMU all start values are float64. A String has a number that stands for
its text: a hash, which is the same in all processes. A variable holds the texts that it may get as
items, as an Enumeration does, so that each process which knows it finds them by their numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.errors import ConfigError, shown

__all__ = [
    "number_of",
    "numbers_of",
    "text_of",
    "texts_of",
    "values_by_name",
    "with_texts",
]

_BITS: Final = 53
"""All integers of so many bits are exact in float64."""

_OFFSET: Final = 0xCBF29CE484222325
_PRIME: Final = 0x100000001B3
"""The constants of FNV-1a for 64 bits (Fowler, Noll and Vo)."""

_numbers: Final[dict[str, float]] = {}
_texts: Final[dict[float, str]] = {}
"""The texts that this process has met, and their numbers."""


def number_of(text: str) -> float:
    """The number that stands for a text.

    Raises:
        ConfigError: If another text has the same number; among 10,000 texts, this has a probability
            of 10^-8.
    """
    number = _numbers.get(text)
    if number is None:
        number = float(_hash(text.encode()))
        if _texts.setdefault(number, text) != text:
            raise ConfigError(
                f"the texts {shown(text)} and {shown(_texts[number])} cannot both be values of "
                "Strings in one process, since they have the same number; change one of them"
            )
        _numbers[text] = number
    return number


def _hash(data: bytes) -> int:
    value = _OFFSET
    for byte in data:
        value = (value ^ byte) * _PRIME % 2**64
    folded: int = (value >> _BITS) ^ (value % 2**_BITS)
    return folded


def text_of(number: float) -> str:
    """The text that a number stands for; "" if this process has not met it."""
    return _texts.get(number, "")


def values_by_name(
    variables: Iterable[Variable], numbers: Iterable[float]
) -> dict[str, float | str]:
    """The values of variables by name, those of Strings as texts."""
    return {
        variable.name: text_of(number) if variable.kind == "string" else number
        for variable, number in zip(variables, numbers, strict=True)
    }


def numbers_of(texts: Iterable[str | None]) -> npt.NDArray[np.float64]:
    """The numbers of texts; NaN for None."""
    return np.array([np.nan if text is None else number_of(text) for text in texts])


def texts_of(numbers: Any) -> Any:
    """The text that a number stands for; of an array of numbers, an array of the same shape."""
    if isinstance(numbers, float):
        return text_of(numbers)
    flat = np.ravel(numbers).tolist()
    return np.array([text_of(number) for number in flat], object).reshape(np.shape(numbers))


def with_texts(variable: Variable, texts: Sequence[str]) -> Variable:
    """The same String with the texts that it may get as items, sorted by their numbers.

    The same arguments give the same variable.
    """
    return _with_texts(variable, tuple(sorted(set(texts), key=number_of)))


@functools.lru_cache(4096)
def _with_texts(variable: Variable, texts: tuple[str, ...]) -> Variable:
    return replace(variable, items=tuple((text, int(number_of(text))) for text in texts))
