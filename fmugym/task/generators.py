"""The states of random generators as rows of numbers."""

from __future__ import annotations

from typing import Any, Final

__all__ = ["row_of", "state_of"]

_WORD: Final = 2**64


def row_of(state: Any) -> list[int]:
    """The state of a ``numpy.random.PCG64`` as six integers of 64 bits.

    They are state and increment (the higher half first), whether a half of a number is left over,
    and that half.
    """
    inner = state["state"]
    numbers = [*divmod(inner["state"], _WORD), *divmod(inner["inc"], _WORD)]
    return [*numbers, state["has_uint32"], state["uinteger"]]


def state_of(row: list[int]) -> dict[str, Any]:
    """The state of a ``numpy.random.PCG64`` from such a row."""
    high, low, increment_high, increment_low, has_half, half = row
    numbers = {"state": high * _WORD + low, "inc": increment_high * _WORD + increment_low}
    return {"bit_generator": "PCG64", "state": numbers, "has_uint32": has_half, "uinteger": half}
