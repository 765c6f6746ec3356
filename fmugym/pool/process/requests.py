"""The requests to workers, and their answers; see ``native/worker``.

Contents are forms; see ``fmugym.pool.form``. A worker runs foreign code, so its answers may be
anything. What does not fit the question is an error, which ends the worker.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import ModelDescription
from fmugym.archive.variable import Variable
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.bundle import SIZE_OF_HEAD, IndexArray
from fmugym.pool.form import Writer
from fmugym.pool.reports import Failure, describe_failure
from fmugym.pool.spec import PoolSpec

__all__ = [
    "Answer",
    "DamagedError",
    "Reader",
    "Request",
    "read_failure",
    "read_states",
    "read_values",
    "request_differentiate",
    "request_index",
    "request_indices",
    "request_listing",
    "request_reset",
    "request_restore",
    "request_restore_states",
    "request_save_states",
    "request_text_of",
    "request_write",
]


class Request(IntEnum):
    """The codes of requests, in the order of ``native/worker/frames.h``."""

    OPEN = 0
    STEP = 1
    STEP_SOME = 2
    RESET = 3
    SAVE = 4
    RESTORE = 5
    RELEASE = 6
    WRITE = 7
    READ = 8
    SAVE_STATES = 9
    RESTORE_STATES = 10
    COUNT_STEPS = 11
    FAILURE = 12
    DIFFERENTIATE = 13
    ROLL_OUT = 14
    TEXT_OF = 15
    CLOSE = 16


class Answer(IntEnum):
    """The codes of what workers send; the letters are those of ``native/worker/frames.h``."""

    FINE = ord("F")
    """The step was done, and no status is worse than a warning."""
    TROUBLE = ord("T")
    """The step was done, and some statuses are worse than a warning."""
    RESULT = ord("R")
    ERROR = ord("E")
    """Why there is no result: a text."""
    FAILURE = ord("X")
    """Why there is no result: the failure of an instance."""
    MESSAGE = ord("L")
    """A message of the FMU, which may come at any time."""
    FAULT = ord("D")
    """The exit status of the process, which ends now. Only programs in Wine tell it."""


class DamagedError(Exception):
    """A worker has sent what is no answer."""


_INTEGER, _NUMBER = struct.Struct("=q"), struct.Struct("=d")
_BLANK: Final = 8


class Reader:
    """Reads a form that a worker has sent.

    Each method raises a ``DamagedError`` if what it reads is not there.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    def _take(self, size: int) -> bytes:
        begin = self._place
        end = begin + size + -size % _BLANK
        if size < 0 or end > len(self._data):
            raise DamagedError("an answer ends too early")
        self._place = end
        return self._data[begin : begin + size]

    def integer(self) -> int:
        """Read an integer."""
        return int(_INTEGER.unpack(self._take(_INTEGER.size))[0])

    def index(self, count: int) -> int:
        """Read an integer from 0 to below a count."""
        number = self.integer()
        if not 0 <= number < count:
            raise DamagedError(f"{number} is not below {count}")
        return number

    def number(self) -> float:
        """Read a floating-point number."""
        return float(_NUMBER.unpack(self._take(_NUMBER.size))[0])

    def block(self) -> bytes:
        """Read bytes with their size."""
        return self._take(self.integer())

    def text(self) -> str:
        """Read a text."""
        data = self.block()
        if not data.endswith(b"\0"):
            raise DamagedError("a text does not end")
        return data[:-1].decode(errors="replace")

    def array(self, shape: tuple[int, ...], dtype: Any) -> npt.NDArray[Any]:
        """Read an array of this shape and type."""
        data, wanted = self.block(), np.dtype(dtype)
        if len(data) != wanted.itemsize * int(np.prod(shape, dtype=object)):
            raise DamagedError(f"an array of another shape than {shape}")
        return np.frombuffer(data, wanted).reshape(shape)

    def end(self) -> None:
        """Require that nothing follows."""
        if self._place != len(self._data):
            raise DamagedError("an answer is too long")


# Requests


def request_indices(numbers: Sequence[int]) -> bytes:
    """A list of numbers."""
    writer = Writer()
    writer.array(numbers, np.int64)
    return writer.form()


def request_index(number: int) -> bytes:
    """A number."""
    writer = Writer()
    writer.integers(number)
    return writer.form()


def request_listing(variables: tuple[Variable, ...], version: int) -> bytes:
    """A list of variables; see ``fmugym.pool.form.table_of``."""
    writer = Writer()
    writer.listing(variables, version)
    return writer.form()


def request_text_of(number: float) -> bytes:
    """A text with this number."""
    writer = Writer()
    writer.numbers(number)
    return writer.form()


def request_reset(
    number: int,
    variables: tuple[Variable, ...] | None,
    version: int,
    values: FloatArray,
    mask: MaskArray,
) -> bytes:
    """A reset.

    Args:
        number: The number of the list of variables.
        variables: The list; None if the process knows it already.
        version: See ``fmugym.pool.form.table_of``.
        values: As for ``Pool.reset``.
        mask: Which instances, shape (N,).
    """
    writer = Writer()
    writer.integers(number, variables is not None)
    if variables is not None:
        writer.listing(variables, version)
    writer.array(values, np.float64)
    writer.array(mask, np.bool_)
    return writer.form()


def request_restore(number: int, mask: MaskArray) -> bytes:
    """Restore the snapshot with this number."""
    writer = Writer()
    writer.integers(number)
    writer.array(mask, np.bool_)
    return writer.form()


def request_write(variables: tuple[Variable, ...], version: int, values: FloatArray) -> bytes:
    """Write variables; see ``Pool.write``."""
    writer = Writer()
    writer.listing(variables, version)
    writer.array(values, np.float64)
    return writer.form()


def request_save_states(indices: IndexArray, records: bool) -> bytes:
    """Save states; see ``SavingPool.save_states``."""
    writer = Writer()
    writer.array(indices, np.int64)
    writer.integers(records)
    return writer.form()


def request_restore_states(states: Sequence[bytes], indices: IndexArray) -> bytes:
    """Restore states; see ``SavingPool.restore_states``."""
    writer = Writer()
    writer.array(indices, np.int64)
    for state in states:
        writer.block(state)
    return writer.form()


def request_differentiate(
    adjoint: bool,
    part: int,
    version: int,
    seeded: tuple[Variable, ...],
    others: tuple[Variable, ...],
) -> bytes:
    """Differentiate; see ``Question`` of ``native/derivatives.h``."""
    writer = Writer()
    writer.integers(adjoint, part)
    writer.listing(seeded, version)
    writer.listing(others, version)
    return writer.form()


# Answers


def read_failure(reader: Reader, description: ModelDescription, spec: PoolSpec, name: str) -> str:
    """Read why an instance of this name has failed; "" if it has not."""
    if not reader.integer():
        return ""
    doing, in_warm_up, status = reader.text(), bool(reader.integer()), reader.integer()
    time, reference, said = reader.number(), reader.integer(), reader.text()
    has_values, values, part = bool(reader.integer()), reader.block(), reader.text()
    reader.end()
    failure = Failure(
        doing, in_warm_up, status, time, reference, said, values if has_values else None, part
    )
    try:
        return describe_failure(failure, description, spec, name)
    except (ValueError, StopIteration):  # another number of values, or unknown numbers
        raise DamagedError("a failure that cannot be") from None


def read_states(reader: Reader, count: int, outputs: int) -> list[bytes]:
    """Read states, so many of them; each has a head and the outputs."""
    if reader.integer() != count:
        raise DamagedError(f"another number of states than {count}")
    states = [reader.block() for _ in range(count)]
    reader.end()
    if any(len(state) < SIZE_OF_HEAD + 8 * outputs for state in states):
        raise DamagedError("a state is too short")
    return states


def read_values(reader: Reader, shape: tuple[int, ...]) -> FloatArray:
    """Read floating-point numbers."""
    values: FloatArray = reader.array(shape, np.float64)
    reader.end()
    return values
