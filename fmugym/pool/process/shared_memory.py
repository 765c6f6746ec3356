"""Arrays that several processes share, in memory without a name.

Memory without a name in the file system is freed with the last process that uses it, however that
process ends. Nothing has to be unlinked, and nothing can be left behind.
"""

from __future__ import annotations

import math
import mmap
import os
import secrets
import sys
import tempfile
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.pool.base import FloatArray, MaskArray, PoolSpec, StatusArray
from fmugym.pool.health import HEALTH_COUNTS, HealthArray

if sys.platform == "linux":
    import fcntl

__all__ = [
    "ECHO_SIZE",
    "Arrays",
    "Memory",
    "make_arrays",
    "make_bell",
    "make_echo",
    "offsets_of",
    "size_for",
]

_ALIGNMENT: Final = 64
"""The alignment of each array, in bytes: a cache line."""


ECHO_SIZE: Final = 4096
"""Bytes for the last words of a worker's FMUs."""

_BELL: Final = np.dtype(np.uint64)

if sys.platform == "linux":
    _ONE_SIZE: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


class Arrays(NamedTuple):
    """The arrays of a pool; see ``Pool``.

    Attributes:
        mask: Which instances not to step, shape (N,).
        counts: See ``fmugym.pool.health``, shape (N, HEALTH_COUNTS).
        progress: The steps of each episode in a rollout, shape (N,).
    """

    inputs: FloatArray
    outputs: FloatArray
    observations: npt.NDArray[np.float32]
    statuses: StatusArray
    mask: MaskArray
    counts: HealthArray
    progress: npt.NDArray[np.int64]

    def block(self, columns: slice) -> Arrays:
        """Return the parts that belong to some of the instances."""
        return Arrays(
            self.inputs[:, columns],
            self.outputs[:, columns],
            self.observations[columns],
            self.statuses[columns],
            self.mask[columns],
            self.counts[columns],
            self.progress[columns],
        )


def _layout(spec: PoolSpec, count: int) -> list[tuple[tuple[int, ...], Any]]:
    return [
        ((len(spec.inputs), count), np.float64),
        ((len(spec.outputs), count), np.float64),
        ((count, spec.num_observed), np.float32),
        ((count,), np.int8),
        ((count,), np.bool_),
        ((count, HEALTH_COUNTS), np.int64),
        ((count,), np.int64),
    ]


def _padded_size(shape: tuple[int, ...], dtype: Any) -> int:
    size = math.prod(shape) * np.dtype(dtype).itemsize
    return int(-(-size // _ALIGNMENT) * _ALIGNMENT)


def size_for(spec: PoolSpec, count: int, workers: int) -> int:
    """Return the bytes that a pool of ``count`` instances needs."""
    return offsets_of(spec, count, workers)[-2]


def make_arrays(memory: Memory, spec: PoolSpec, count: int) -> Arrays:
    """Place the arrays of a pool of ``count`` instances in memory, which they keep alive."""
    arrays: list[Any] = [
        np.ndarray(shape, dtype, memory.map, offset)
        for (shape, dtype), offset in zip(
            _layout(spec, count), offsets_of(spec, count), strict=False
        )
    ]
    return Arrays(*arrays)


def offsets_of(spec: PoolSpec, count: int, worker: int = 0) -> list[int]:
    """Where the arrays begin, in the order of ``Arrays``, and then what belongs to a worker.

    That is ``ECHO_SIZE`` bytes for its last words, and its bell.
    """
    offsets = [0]
    for row in _layout(spec, count):
        offsets.append(offsets[-1] + _padded_size(*row))
    offsets[-1] += worker * (ECHO_SIZE + _ALIGNMENT)
    return [*offsets, offsets[-1] + ECHO_SIZE]


def make_echo(memory: Memory, spec: PoolSpec, count: int, worker: int) -> npt.NDArray[np.uint8]:
    """Return where a worker's FMUs leave their last words, a text that ends with a zero byte."""
    return np.ndarray(ECHO_SIZE, np.uint8, memory.map, offsets_of(spec, count, worker)[-2])


def make_bell(memory: Memory, spec: PoolSpec, count: int, worker: int) -> memoryview:
    """Return the count of the messages to a worker, as the only element of a view."""
    return np.ndarray(1, _BELL, memory.map, offsets_of(spec, count, worker)[-1]).data


class Memory:
    """Shared memory, filled with zeros.

    Args:
        size: In bytes, not 0.
        descriptor: The file descriptor of memory that another process has made.
        tag: Its name instead, on Windows, which frees the name together with the memory.

    Raises:
        OSError: If the system refuses.

    Attributes:
        size: In bytes.
        descriptor: The file descriptor; -1 on Windows.
        tag: The name on Windows.
        map: The memory itself.
    """

    def __init__(self, size: int, descriptor: int = -1, tag: str = "") -> None:
        self.size = size
        self.descriptor, self.tag = descriptor, tag
        if sys.platform == "win32":
            self.tag = tag or f"fmugym-{os.getpid()}-{secrets.token_hex(8)}"
            self.map = mmap.mmap(-1, size, self.tag)
        else:
            self.descriptor = _anonymous_file(size) if descriptor < 0 else descriptor
            self.map = mmap.mmap(self.descriptor, size)

    def close(self) -> None:
        """Close the file descriptor; the mapped memory stays as long as it is in use."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


def _anonymous_file(size: int) -> int:
    if sys.platform == "linux":
        descriptor = os.memfd_create("fmugym", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    if sys.platform == "linux":  # a worker that shrinks it would end all processes that use it
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, _ONE_SIZE)
    return descriptor
