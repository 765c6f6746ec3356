"""Engine: requests to it, in this process or through a worker, its answers, and its pools.

The tables of CONTRIBUTING.md say what a request and an answer consist of.
``native/pool/requests.c`` is the other end. A worker runs foreign code, so its answers may be
anything. What does not fit the request is an error, which ends the worker. The pools of the engine
share their requests besides steps and resets.
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from fmugym.errors import SimulationError, first_of
from fmugym.fmi.description import ModelDescription
from fmugym.fmi.variable import Variable
from fmugym.pool.derivatives import Variables, differentiated
from fmugym.pool.failure_texts import Failure, describe_failure
from fmugym.pool.pool import FloatArray
from fmugym.pool.pool_form import BLANK, FLOAT64, INTEGER, Writer, table_of
from fmugym.pool.pool_spec import PoolSpec
from fmugym.pool.saving_pool import SavingPool
from fmugym.pool.states import NO_SNAPSHOT, SIZE_OF_HEAD, IndexArray

__all__ = [
    "Answer",
    "Answers",
    "DamagedError",
    "EnginePool",
    "Reader",
    "Request",
    "read_states",
    "read_values",
    "request_listing",
    "request_restore",
    "request_restore_snapshot",
    "request_save",
]


class Request(IntEnum):
    """The codes of requests, in the order of ``native/pool/requests.h``."""

    OPEN = 0
    STEP = 1
    START = 2
    READ = 3
    WRITE = 4
    DIFFERENTIATE = 5
    SAVE = 6
    RESTORE = 7
    FAILURE = 8
    CLOSE = 9


class Answer(IntEnum):
    """Codes of answers, by the letters of ``native/pool/requests.h``."""

    RESULT = ord("R")
    TROUBLE = ord("T")
    """To a step: some statuses are worse than a warning. To others: the failure of an instance."""
    ERROR = ord("E")
    """The reason why there is no result, a text."""
    LOG = ord("L")
    """A message of the FMU, which may come at any time."""
    FAULT = ord("D")
    """The exit status of the process, which ends now. Only programs in Wine tell it."""


class DamagedError(Exception):
    """Error: a worker has sent bytes that are no answer."""


class Reader:
    """Reads a form that a worker has sent.

    Each method raises a ``DamagedError`` if what it reads is not there.
    """

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    def _take(self, size: int) -> bytes:
        begin = self._place
        end = begin + size + -size % BLANK
        if size < 0 or end > len(self._data):
            raise DamagedError("an answer ends too early")
        self._place = end
        return self._data[begin : begin + size]

    def integer(self) -> int:
        """Read an integer."""
        return int(INTEGER.unpack(self._take(INTEGER.size))[0])

    def index(self, count: int) -> int:
        """Read an integer from 0 to below a count."""
        number = self.integer()
        if not 0 <= number < count:
            raise DamagedError(f"{number} is not below {count}")
        return number

    def number(self) -> float:
        """Read a floating-point number."""
        return float(FLOAT64.unpack(self._take(FLOAT64.size))[0])

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
        data = self.block()
        try:
            return np.frombuffer(data, dtype).reshape(shape)
        except ValueError:
            raise DamagedError(f"an array of another shape than {shape}") from None

    def blocks(self, count: int) -> list[bytes]:
        """Read so many blocks."""
        return [self._take(INTEGER.unpack(self._take(BLANK))[0]) for _ in range(count)]

    def end(self) -> None:
        """Require that nothing follows."""
        if self._place != len(self._data):
            raise DamagedError("an answer is too long")


class Answers:
    """Reads the answers of some instances.

    Args:
        description: That of the FMU or system.
        spec: That of their pool.
        block: The indices of these instances.
    """

    def __init__(self, description: ModelDescription, spec: PoolSpec, block: slice) -> None:
        self._description, self._spec, self._block = description, spec, block

    @property
    def count(self) -> int:
        """Number of instances."""
        return int(self._block.stop - self._block.start)

    def result(self, code: int, reader: Reader, read: Callable[[Reader], Any]) -> Any:
        """The result that ``read`` reads from an answer, or the error that it tells.

        Raises:
            DamagedError: If it is no answer.
        """
        if code == Answer.RESULT:
            return read(reader)
        if code == Answer.ERROR:
            return SimulationError(reader.text())
        if code == Answer.TROUBLE:
            return SimulationError(self.failure(reader, reader.index(self.count)))
        raise DamagedError(f"the code {code}")

    def failure(self, reader: Reader, index: int) -> str:
        """Read why an instance has failed, counted within the block; "" if it has not."""
        if not reader.integer():
            return ""
        failure = Failure(
            doing=reader.text(),
            in_warm_up=bool(reader.integer()),
            status=reader.integer(),
            time=reader.number(),
            reference=reader.integer(),
            said=reader.text(),
            has_values=bool(reader.integer()),
            values=reader.block(),
            part=reader.text(),
        )
        reader.end()
        name = f"{self._description.model_identifier}_{self._block.start + index}"
        try:
            return describe_failure(failure, self._description, self._spec, name)
        except (ValueError, StopIteration):  # another number of values, or unknown numbers
            raise DamagedError("a failure that cannot be") from None


def read_states(reader: Reader, count: int, outputs: int) -> list[bytes]:
    """Read states, so many of them; each has a head and the outputs."""
    states = reader.blocks(count)
    reader.end()
    if any(len(state) < SIZE_OF_HEAD + 8 * outputs for state in states):
        raise DamagedError("a state is too short")
    return states


def read_values(reader: Reader, shape: tuple[int, ...]) -> FloatArray:
    """Read floating-point numbers."""
    values: FloatArray = reader.array(shape, np.float64)
    reader.end()
    return values


# Requests


@functools.lru_cache(maxsize=64)
def request_listing(variables: tuple[Variable, ...], version: int) -> bytes:
    """A list of variables; see ``fmugym.pool.pool_form.table_of``."""
    return Writer().listing(variables, version).form()


def request_save(
    indices: IndexArray, records: bool, snapshot: int = NO_SNAPSHOT, dropped: Sequence[int] = ()
) -> bytes:
    """Save states or records as values, or in a new snapshot; some others are dropped before."""
    writer = Writer().array(indices, np.int64).integers(records, snapshot)
    return writer.array(dropped, np.int64).form()


def request_restore(states: Sequence[bytes], sources: IndexArray, indices: IndexArray) -> bytes:
    """Restore states: ``indices[i]`` gets ``states[sources[i]]``, which is sent once."""
    used, places = np.unique(sources, return_inverse=True)
    writer = Writer().array(indices, np.int64).integers(NO_SNAPSHOT).array(places, np.int64)
    for place in used.tolist():
        writer.block(states[place])
    return writer.form()


def request_restore_snapshot(number: int, indices: IndexArray) -> bytes:
    """Restore a snapshot."""
    return Writer().array(indices, np.int64).integers(number).array([], np.int64).form()


R = TypeVar("R")


class EnginePool(SavingPool):
    """A pool whose instances are in blocks, here or in other processes, asked by forms."""

    @abstractmethod
    def _ask(
        self,
        doing: str,
        request: Request,
        content: Callable[[slice], bytes],
        read: Callable[[Reader, int], R],
    ) -> list[R]:
        """Ask all blocks of instances.

        Args:
            doing: What they do then.
            request: What they are asked for.
            content: Makes the content of the request for a block.
            read: Reads the answer of so many instances.

        Returns:
            What was read, in the order of the blocks.

        Raises:
            SimulationError: If an instance refuses.
        """

    def _ask_for_values(
        self, doing: str, request: Request, content: bytes, *shape: int
    ) -> FloatArray:
        """Ask for an array of a shape whose last axis, that of the instances, is left out."""
        parts = self._ask(
            doing,
            request,
            lambda _: content,
            lambda reader, count: read_values(reader, (*shape, count)),
        )
        return parts[0].copy() if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        doing, content = "reading variables", request_listing(variables, self._version)
        try:
            return self._ask_for_values(doing, Request.READ, content, len(variables))
        except SimulationError as error:
            names = first_of([variable.name for variable in variables])
            text = str(error).replace(doing, f"reading {names}", 1)
            raise SimulationError(text) from None

    def write(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        """See ``Pool.write``."""
        listing = request_listing(variables, self._version)
        self._ask(
            "setting parameters",
            Request.WRITE,
            lambda block: Writer().forms(listing).array(values[:, block], np.float64).form(),
            lambda reader, _: reader.end(),
        )

    def _save_snapshot(self, number: int, dropped: Sequence[int]) -> None:
        """See ``SavingPool._save_snapshot``."""

        def content(block: slice) -> bytes:
            indices = np.arange(block.stop - block.start)
            return request_save(indices, False, number, dropped)

        self._ask("saving a state", Request.SAVE, content, lambda reader, _: reader.end())

    def differentiate(self, unknowns: Variables, knowns: Variables) -> FloatArray:
        """See ``Pool.differentiate``."""
        description, spec = self._form
        about = description, spec, self.num_instances
        return differentiated(*about, self._differentiate, unknowns, knowns)

    def _differentiate(
        self, adjoint: bool, part: int, version: int, seeded: Variables, others: Variables
    ) -> FloatArray:
        lists = request_listing(seeded, version), request_listing(others, version)
        content = Writer().integers(adjoint, part).forms(*lists).form()
        shape = len(seeded), len(others)
        doing = "a directional derivative"
        return self._ask_for_values(doing, Request.DIFFERENTIATE, content, *shape)

    @property
    def _version(self) -> int:
        """See ``fmugym.pool.pool_form.table_of``."""
        return table_of(self._form[0])
