"""Numbers that stand for the start values of Strings.

Between the draws and an FMU all start values are float64. A String holds the texts that it may get
as items, as an Enumeration does; the number of a text is its place among them. It means nothing
without the variable: what outlives a list of variables holds the text.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable, checked_value

__all__ = [
    "Texts",
    "start_of",
    "texts_at",
    "texts_of",
    "values_by_name",
    "with_texts",
]


Texts = Sequence[str] | npt.NDArray[np.object_]
"""Texts by their places; in an array may be None."""


def with_texts(variable: Variable, texts: Iterable[str]) -> Variable:
    """The same String with the texts that it may get as items, each once, in their order.

    The same arguments give the same variable.
    """
    return _with_texts(variable, tuple(dict.fromkeys(map(str.__str__, texts))))


@functools.lru_cache(4096)
def _with_texts(variable: Variable, texts: tuple[str, ...]) -> Variable:
    return replace(variable, items=tuple((text, place) for place, text in enumerate(texts)))


def start_of(variable: Variable, value: Any) -> tuple[Variable, float]:
    """A variable that starts with a value, and the number for it; a String knows only this text.

    Raises:
        ConfigError: If the value is neither a number that fits nor the text of a String.
    """
    is_text = variable.kind == "string" and isinstance(value, str)
    own = with_texts(variable, [value]) if is_text else variable
    return own, checked_value(own, value)


def texts_of(variable: Variable) -> tuple[str, ...]:
    """The texts that a String may get, in the order of their numbers."""
    return tuple(text for text, _ in variable.items)


def texts_at(texts: Texts, numbers: Any) -> Any:
    """The text at the place that a number tells, or None if there is none.

    Args:
        texts: The texts.
        numbers: A number, or an array of numbers.

    Returns:
        The text; of an array, an array of objects of the same shape.
    """
    if isinstance(numbers, float):
        return texts[int(numbers)] if 0 <= numbers < len(texts) else None
    found = np.full(np.shape(numbers), None, object)
    present = (numbers >= 0) & (numbers < len(texts))
    found[present] = np.array(texts, object)[numbers[present].astype(np.int64)]
    return found


def values_by_name(
    variables: Iterable[Variable], numbers: Iterable[float]
) -> dict[str, float | str]:
    """Values of variables by name, with texts for Strings."""
    return {
        variable.name: variable.items[int(number)][0] if variable.kind == "string" else number
        for variable, number in zip(variables, numbers, strict=True)
    }
