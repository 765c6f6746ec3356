"""Form of programs around steps of a vector environment; ``native/pool/play_form.c`` reads it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.pool.pool_form import Writer

__all__ = ["ArrayElement", "RowStart", "Rows", "form_of_play"]

_Row = npt.NDArray[Any]


class ArrayElement(NamedTuple):
    """Row of a program in an array that each call brings, and in which the program only stores.

    Attributes:
        array: The number of the array among those of a call.
        element: The place of the element in the part of an environment.
        elements: How many elements this part has.
        type: The place of its type in ``fmugym.expressions.program.TYPES``.
    """

    array: int
    element: int
    elements: int
    type: int


RowStart = bytes | _Row | int
"""The value of a row where an episode starts: the bytes of a constant, those of another row, or a
draw's number."""


class Rows:
    """Rows of memory that a form names by numbers.

    Attributes:
        arrays: Those that have a number, in its order.
        elements: Those in arrays of a call, which have the numbers from -1 downwards.
    """

    def __init__(self) -> None:
        self.arrays: list[_Row] = []
        self.elements: list[ArrayElement] = []
        self._numbers: dict[Any, int] = {}

    def number(self, row: _Row | ArrayElement) -> int:
        """The number of a row, which gets one if its memory has none."""
        if isinstance(row, ArrayElement):
            self.elements.append(row)
            return -len(self.elements)
        memory = row.__array_interface__["data"][0], row.strides, row.dtype
        if memory not in self._numbers:
            self._numbers[memory] = len(self.arrays)
            self.arrays.append(row)
        return self._numbers[memory]


def form_of_play(
    rows: Rows,
    programs: Iterable[tuple[bytes, Iterable[_Row | ArrayElement]]],
    actions: Mapping[str, Any],
    surroundings: Mapping[str, Any],
) -> bytes:
    """The form of a play.

    Args:
        rows: Get numbers.
        programs: As for ``NativePool.prepare_play``.
        actions: As for ``NativePool.prepare_play``.
        surroundings: As for ``NativePool.prepare_play``.
    """
    number, none = rows.number, actions["none"]
    writer = Writer().integers(surroundings["reads_kept"], surroundings["seen"], none.size)
    writer.integers(*(actions[name] for name in ("size", "check", "lowest", "highest")))
    writer.block(none.tobytes())
    for moment in ("before_inputs", "before_conclusion"):
        pairs = surroundings[moment]
        writer.array([[number(source), number(to)] for source, to in pairs], np.int64)
    starts, unstepped = (
        [(number(row), *_start_of(rows, source)) for row, source in surroundings[moment]]
        for moment in ("starts", "unstepped")
    )
    inputs, conclusion, observation = ((form, [*map(number, own)]) for form, own in programs)
    writer.array(starts, np.int64)
    writer.block(inputs[0]).array(inputs[1], np.int64).array(rows.elements, np.int64)
    writer.block(conclusion[0]).array(conclusion[1], np.int64).array(unstepped, np.int64)
    writer.block(observation[0]).array(observation[1], np.int64)
    return writer.form()


def _start_of(rows: Rows, source: RowStart) -> tuple[int, int]:
    """The kind of a start, a ``StartKind`` of ``native/pool/play.h``, and its number."""
    if isinstance(source, bytes):
        return 0, _bits_of(source)
    return (2, source) if isinstance(source, int) else (1, rows.number(source))


def _bits_of(value: bytes) -> int:
    """The bits of a value of up to 8 bytes."""
    return int.from_bytes(value.ljust(8, b"\0"), sys.byteorder, signed=True)
