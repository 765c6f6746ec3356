"""The messages to and from the worker program for Windows; see ``native/worker``.

Numbers are little-endian: integers and floating-point numbers of 8 bytes, flags of one. A text or
block begins with its length. The program answers requests in their order.
"""

from __future__ import annotations

import logging
import os
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.errors import FMUGymError, FMULoadError, SimulationError
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.bundle import IndexArray
from fmugym.pool.process.channel import Code
from fmugym.pool.process.shared_memory import ECHO_SIZE, Memory, offsets_of
from fmugym.pool.process.worker import Setup
from fmugym.pool.reports import Failure, as_record, describe_failure, loading_failed
from fmugym.pool.saving import keeps_records
from fmugym.pool.settings import (
    PlaceOfFMU,
    experiment_settings,
    library_settings,
    listing,
    manner_of,
    solving_settings,
    variable_settings,
)
from fmugym.wine.loader import windows_path

__all__ = ["REQUESTS", "ProgramCoding"]

REQUESTS: Final = (
    "reset",
    "save",
    "restore",
    "write",
    "save_states",
    "restore_states",
    "count_steps",
    "failure",
    "read",
    "differentiate",
    "text_of",
    "close",
)
"""In the order of ``native/worker/requests.c``. They are the methods of ``BlockWorker``."""

_NUMBERS: Final = {name: number for number, name in enumerate(REQUESTS)}
_UNKNOWN: Final = 255
"""The number of a request that the program refuses."""

_INTEGER, _NUMBER, _FLAG = struct.Struct("<q"), struct.Struct("<d"), struct.Struct("<?")
_FAULT: Final = struct.Struct("<I")
_OF_INSTANCE: Final = 1
"""The kind of an error that is the failure of an instance; of others it is 0."""


class _Writer:
    """Writes the content of a message."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []

    def integers(self, *numbers: int) -> None:
        self.parts += [_INTEGER.pack(number) for number in numbers]

    def numbers(self, *numbers: float) -> None:
        self.parts += [_NUMBER.pack(number) for number in numbers]

    def flags(self, *flags: bool) -> None:
        self.parts += [_FLAG.pack(flag) for flag in flags]

    def block(self, data: bytes) -> None:
        self.parts += [_INTEGER.pack(len(data)), data]

    def text(self, data: bytes) -> None:
        self.block(data)
        self.parts.append(b"\0")

    def values(self, array: Any, dtype: Any) -> None:
        self.parts.append(np.ascontiguousarray(array, dtype).tobytes())

    def access(self, variables: Sequence[Variable], version: int) -> None:
        for part in listing(variables, version):
            self.block(part)

    def optional(self, number: float | None) -> None:
        self.flags(number is not None)
        self.numbers(number or 0.0)


class _Reader:
    """Reads the content of a message."""

    def __init__(self, data: bytearray) -> None:
        self._data, self._place = data, 0

    def _take(self, size: int) -> bytes:
        begin, self._place = self._place, self._place + size
        return bytes(self._data[begin : self._place])

    @property
    def is_done(self) -> bool:
        return self._place >= len(self._data)

    def integer(self) -> int:
        return int(_INTEGER.unpack(self._take(_INTEGER.size))[0])

    def number(self) -> float:
        return float(_NUMBER.unpack(self._take(_NUMBER.size))[0])

    def flag(self) -> bool:
        return self._take(1) != b"\0"

    def block(self) -> bytes:
        return self._take(self.integer())

    def text(self) -> str:
        return self.block().decode(errors="replace")

    def rest(self) -> bytes:
        return self._take(len(self._data) - self._place)


class ProgramCoding:
    """The coding between this process and one process of the program; see ``Coding``.

    Args:
        memory: Shared with the program.

    Attributes:
        initializations: How many initializations all programs that this process has started have
            begun.
    """

    initializations: ClassVar[int] = 0
    _setup: Setup

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self._asked: deque[tuple[str, tuple[Any, ...]]] = deque()  # without an answer so far
        self._initializations = 0

    def dumps(self, code: bytes, content: Any) -> bytes:
        """See ``Coding.dumps``; the object of a request is its name and its arguments."""
        writer = _Writer()
        if code == Code.RELEASE:
            writer.integers(len(content), *content)
            return b"".join(writer.parts)
        name, arguments = content
        self._asked.append((name, arguments))
        if name != "open":
            writer.parts.append(bytes([_NUMBERS.get(name, _UNKNOWN)]))
        write: Callable[..., None] | None = getattr(self, f"_ask_{name}", None)
        if write is not None:
            write(writer, *arguments)
        return b"".join(writer.parts)

    def loads(self, code: bytes, data: bytearray) -> Any:
        """See ``Coding.loads``."""
        reader = _Reader(data)
        if code == Code.LOG:
            return self._message(reader)
        if code == Code.FAULT:
            return _FAULT.unpack(data)[0]
        name, arguments = self._asked.popleft()
        if code == Code.ERROR:
            return self._error(reader, name)
        read: Callable[..., Any] | None = getattr(self, f"_answer_{name}", None)
        return None if read is None else read(reader, *arguments)

    # Messages and errors

    def _name(self, index: int) -> str:
        number = self._setup.block.start + index
        return f"{self._setup.description.model_identifier}_{number}"

    def _message(self, reader: _Reader) -> tuple[int, str]:
        index, status = reader.integer(), reader.integer()
        return as_record(self._name(index), status, reader.text(), reader.text())

    def _error(self, reader: _Reader, asked: str) -> FMUGymError:
        if reader.flag() == _OF_INSTANCE:
            return SimulationError(self._failure(reader, reader.integer()))
        text = reader.text()
        if asked == "open":
            return FMULoadError(loading_failed(self._setup.path.name, text))
        return SimulationError(text)

    def _failure(self, reader: _Reader, index: int) -> str:
        if not reader.flag():
            return ""
        doing, in_warm_up, status = reader.text(), bool(reader.integer()), reader.integer()
        time, string, said = reader.number(), reader.integer(), reader.text()
        has_values, values = bool(reader.integer()), reader.block()
        failure = Failure(
            doing, in_warm_up, status, time, string, said, values if has_values else None
        )
        setup = self._setup
        return describe_failure(failure, setup.description, setup.spec, self._name(index))

    # The first request, which has no number

    def _ask_open(self, writer: _Writer, setup: Setup) -> None:
        self._setup = setup
        description = setup.description
        spec = setup.spec.fitting(description)
        place = PlaceOfFMU.in_wine(
            setup.folder, setup.folder / setup.library, description.fmi_major_version
        )
        writer.integers(description.fmi_major_version, manner_of(description, spec))
        _write_solving(writer, solving_settings(description, spec))
        _write_library(writer, library_settings(description, spec, place), setup.log_level)
        experiment = experiment_settings(spec, records=keeps_records(description, spec))
        _write_experiment(writer, experiment)
        writer.access(spec.inputs, description.fmi_major_version)
        writer.access(spec.outputs, description.fmi_major_version)
        _write_variables(writer, variable_settings(spec))
        writer.block(experiment["start_outputs"] or b"")
        writer.integers(setup.block.stop - setup.block.start, setup.threads)
        self._write_memory(writer, setup)

    def _write_memory(self, writer: _Writer, setup: Setup) -> None:
        """Name the memory, which has no name of its own, by this process's descriptor of it."""
        path = Path("/proc", str(os.getpid()), "fd", str(self._memory.descriptor))
        writer.text(os.fsencode(windows_path(path)))
        writer.integers(self._memory.size, setup.num_instances, setup.block.start)
        writer.integers(*offsets_of(setup.spec, setup.num_instances, setup.number), ECHO_SIZE)

    # Other requests, and their answers

    @property
    def _version(self) -> int:
        return self._setup.description.fmi_major_version

    def _ask_reset(
        self,
        writer: _Writer,
        number: int,
        variables: tuple[Variable, ...] | None,
        values: FloatArray,
        mask: MaskArray,
    ) -> None:
        writer.integers(number)
        writer.flags(variables is not None)
        if variables is not None:
            writer.access(variables, self._version)
        writer.values(values, np.float64)
        writer.values(mask, np.bool_)

    def _answer_reset(self, reader: _Reader, *_: Any) -> int:
        growth, count = reader.integer(), reader.integer()
        ProgramCoding.initializations += count - self._initializations
        self._initializations = count
        return growth

    def _answer_save(self, reader: _Reader) -> int:
        return reader.integer()

    def _ask_restore(self, writer: _Writer, number: int, mask: MaskArray) -> None:
        writer.integers(number)
        writer.values(mask, np.bool_)

    def _ask_write(
        self, writer: _Writer, variables: tuple[Variable, ...], values: FloatArray
    ) -> None:
        writer.access(variables, self._version)
        writer.values(values, np.float64)

    def _ask_save_states(self, writer: _Writer, indices: IndexArray, records: bool) -> None:
        writer.block(np.ascontiguousarray(indices, np.int64).tobytes())
        writer.flags(records)

    def _answer_save_states(self, reader: _Reader, *_: Any) -> list[bytes]:
        states = []
        while not reader.is_done:
            states.append(reader.block())
        return states

    def _ask_restore_states(
        self, writer: _Writer, states: Sequence[bytes], indices: IndexArray
    ) -> None:
        writer.block(np.ascontiguousarray(indices, np.int64).tobytes())
        for state in states:
            writer.block(state)

    def _ask_failure(self, writer: _Writer, index: int) -> None:
        writer.integers(index)

    def _answer_failure(self, reader: _Reader, index: int) -> str:
        return self._failure(reader, index)

    def _ask_read(self, writer: _Writer, variables: tuple[Variable, ...]) -> None:
        writer.access(variables, self._version)

    def _answer_read(self, reader: _Reader, variables: tuple[Variable, ...]) -> FloatArray:
        block = self._setup.block
        shape = len(variables), block.stop - block.start
        return np.frombuffer(reader.rest(), np.float64).reshape(shape)

    def _ask_text_of(self, writer: _Writer, number: float) -> None:
        writer.numbers(number)

    def _answer_text_of(self, reader: _Reader, _: float) -> str:
        return reader.text()

    @property
    def _is_adjoint(self) -> bool:
        """Whether the FMU differentiates unknowns by all knowns, not all unknowns by a known."""
        return not self._setup.description.capabilities.provides_directional_derivatives

    def _ask_differentiate(
        self, writer: _Writer, unknowns: tuple[Variable, ...], knowns: tuple[Variable, ...]
    ) -> None:
        writer.flags(self._is_adjoint)
        for some in (unknowns, knowns) if self._is_adjoint else (knowns, unknowns):
            writer.access(some, self._version)

    def _answer_differentiate(
        self, reader: _Reader, unknowns: tuple[Variable, ...], knowns: tuple[Variable, ...]
    ) -> FloatArray:
        seeded, others = (unknowns, knowns) if self._is_adjoint else (knowns, unknowns)
        block = self._setup.block
        shape = len(seeded), len(others), block.stop - block.start
        found = np.frombuffer(reader.rest(), np.float64).reshape(shape)
        return found if self._is_adjoint else found.swapaxes(0, 1)


def _write_library(writer: _Writer, library: Mapping[str, Any], log_level: int) -> None:
    for name in ("model", "token", "resources"):
        writer.text(library[name])
    _write_texts(writer, library["paths"])
    writer.flags(log_level <= logging.INFO, library["states"])
    _write_texts(writer, library["categories"])
    for name in ("structural_references", "structural_values"):
        writer.block(library[name])


def _write_solving(writer: _Writer, solving: tuple[Any, ...] | None) -> None:
    writer.flags(solving is not None)
    if solving is not None:
        name, tolerance, max_step, states, indicators, completes, *blocks = solving
        writer.text(name)
        writer.numbers(tolerance, max_step)
        writer.integers(states, indicators)
        writer.flags(completes)
        for block in blocks:
            writer.block(block or b"")


def _write_texts(writer: _Writer, texts: Sequence[bytes]) -> None:
    writer.integers(len(texts))
    for text in texts:
        writer.text(text)


def _write_experiment(writer: _Writer, experiment: Mapping[str, Any]) -> None:
    writer.numbers(experiment["start_time"])
    writer.optional(experiment["stop_time"])
    writer.optional(experiment["tolerance"])
    writer.numbers(experiment["time_step"])
    writer.integers(*(experiment[name] for name in ("substeps", "warm_up_steps", "retries")))
    names = ("restores", "rebuilds", "reloads", "one_initialization", "records")
    writer.flags(*(experiment[name] for name in names))


def _write_variables(writer: _Writer, variables: Mapping[str, Any]) -> None:
    writer.integers(variables["num_observed"])
    writer.block(variables["sampling"])
