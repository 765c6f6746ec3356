"""Arrays that a worker shares with its parent, in memory without a name.

Memory without a name in the file system is freed with the last process that uses it, however that
process ends. Nothing has to be unlinked, and nothing can be left behind.
"""

from __future__ import annotations

import itertools
import math
import mmap
import os
import secrets
import sys
import tempfile
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.pool.health import Arrays, HealthArray, layout_of
from fmugym.pool.pool_spec import PoolSpec

if sys.platform == "linux":
    import fcntl

__all__ = ["ECHO_SIZE", "BlockCopies", "Memory"]

_ALIGNMENT: Final = 64
"""The alignment of each array, in bytes: a cache line."""

ECHO_SIZE: Final = 4096
"""Bytes for the last words of a worker's FMUs."""

_BELL: Final = np.dtype(np.uint64)

if sys.platform == "linux":
    _ONE_SIZE: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


def _padded_size(shape: tuple[int, ...], dtype: Any) -> int:
    size = math.prod(shape) * np.dtype(dtype).itemsize
    return int(-(-size // _ALIGNMENT) * _ALIGNMENT)


class Memory:
    """Memory that a pool and one worker share, zeros at first; no other worker can reach it.

    Args:
        spec: Names the inputs and outputs.
        count: The number of the worker's instances.

    Raises:
        OSError: If the system refuses.

    Attributes:
        size: In bytes.
        descriptor: The file descriptor; -1 on Windows.
        tag: The name on Windows, which frees it together with the memory.
        map: The memory itself.
        arrays: Those of the worker's instances.
    """

    def __init__(self, spec: PoolSpec, count: int) -> None:
        layout = layout_of(spec, count)
        sizes = [_padded_size(*row) for row in layout]
        *self._offsets, echo = itertools.accumulate(sizes, initial=0)
        self._echo, self._bell = echo, echo + ECHO_SIZE
        self.size = self._bell + _ALIGNMENT
        self.descriptor, self.tag = -1, ""
        if sys.platform == "win32":
            self.tag = f"fmugym-{os.getpid()}-{secrets.token_hex(8)}"
            self.map = mmap.mmap(-1, self.size, self.tag)
        else:
            self.descriptor = _anonymous_file(self.size)
            self.map = mmap.mmap(self.descriptor, self.size)
        places = zip(layout, self._offsets, strict=True)
        arrays = [np.ndarray(*row, self.map, offset) for row, offset in places]
        self.arrays = Arrays(*arrays)

    @property
    def offsets(self) -> list[int]:
        """Offsets of the arrays, in the order of ``Arrays``, and then of the echo and the bell."""
        return [*self._offsets, self._echo, self._bell]

    @property
    def echo(self) -> npt.NDArray[np.uint8]:
        """Memory of the last words of the worker's FMUs, a text that ends with a zero byte."""
        return np.ndarray(ECHO_SIZE, np.uint8, self.map, self._echo)

    @property
    def bell(self) -> memoryview:
        """The count of the messages to the worker, as the only element of a view."""
        return np.ndarray(1, _BELL, self.map, self._bell).data

    def close(self) -> None:
        """Close the file descriptor; the mapped memory stays as long as it is in use."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


class BlockCopies:
    """Copies a block of the arrays of a pool to the memory of a worker, and back.

    The counts are the worker's; the pool gets them when somebody asks for them.

    Args:
        arrays: Those of the pool; nothing is copied if they are those of the memory.
        block: The indices of the worker's instances.
        memory: That of the worker.
    """

    def __init__(self, arrays: Arrays, block: slice, memory: Memory) -> None:
        own = memory.arrays._asdict()
        blocks = {
            "inputs": arrays.inputs[:, block],
            "mask": arrays.mask[block],
            "outputs": arrays.outputs[:, block],
            "observations": arrays.observations[block],
            "statuses": arrays.statuses[block],
        }
        self._counts: tuple[tuple[HealthArray, ...], tuple[HealthArray, ...]] = ((), ())
        if arrays is memory.arrays:
            blocks = {}
        else:
            self._counts = (arrays.counts[block],), (memory.arrays.counts,)
        blocks = {name: block for name, block in blocks.items() if block.size}
        self._pairs = tuple(own[name] for name in blocks), tuple(blocks.values())
        read = [name for name in ("inputs", "mask") if name in blocks]
        self._for_step = tuple(own[name] for name in read), tuple(blocks[name] for name in read)

    def give(self) -> None:
        """Copy the arrays that the worker may read or change."""
        _copy(*self._pairs)

    def give_for_step(self) -> None:
        """Copy the arrays that the worker reads in a step; it writes all others."""
        _copy(*self._for_step)

    def take(self) -> None:
        """Copy the arrays that the worker may have changed."""
        shared, blocks = self._pairs
        _copy(blocks, shared)

    def take_counts(self) -> None:
        """Copy the counts."""
        _copy(*self._counts)


def _copy(targets: tuple[npt.NDArray[Any], ...], sources: tuple[npt.NDArray[Any], ...]) -> None:
    for target, source in zip(targets, sources, strict=True):
        np.copyto(target, source)


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
