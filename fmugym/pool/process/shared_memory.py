"""Arrays that several processes share, in memory without a name.

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

from fmugym.pool.health import Arrays, layout_of
from fmugym.pool.spec import PoolSpec

if sys.platform == "linux":
    import fcntl

__all__ = ["ECHO_SIZE", "Memory"]

_ALIGNMENT: Final = 64
"""The alignment of each array, in bytes: a cache line."""

ECHO_SIZE: Final = 4096
"""Bytes for the last words of a worker's FMUs."""

_OWN_SIZE: Final = ECHO_SIZE + _ALIGNMENT
"""Bytes for a worker: its echo, and its bell."""

_BELL: Final = np.dtype(np.uint64)

if sys.platform == "linux":
    _ONE_SIZE: Final = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


def _padded_size(shape: tuple[int, ...], dtype: Any) -> int:
    size = math.prod(shape) * np.dtype(dtype).itemsize
    return int(-(-size // _ALIGNMENT) * _ALIGNMENT)


class Memory:
    """What a pool and its workers share, filled with zeros.

    Args:
        spec: Names the inputs and outputs.
        count: N.
        workers: How many there are.

    Raises:
        OSError: If the system refuses.

    Attributes:
        size: In bytes.
        descriptor: The file descriptor; -1 on Windows.
        tag: The name on Windows, which frees it together with the memory.
        map: The memory itself.
        arrays: Those of all instances.
    """

    def __init__(self, spec: PoolSpec, count: int, workers: int) -> None:
        layout = layout_of(spec, count)
        sizes = [_padded_size(*row) for row in layout]
        *self._offsets, self._end = itertools.accumulate(sizes, initial=0)
        self.size = self._end + workers * _OWN_SIZE
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

    def offsets(self, worker: int) -> list[int]:
        """Where the arrays begin, in the order of ``Arrays``, and then a worker's echo and bell."""
        echo = self._end + worker * _OWN_SIZE
        return [*self._offsets, echo, echo + ECHO_SIZE]

    def echo(self, worker: int) -> npt.NDArray[np.uint8]:
        """Where a worker's FMUs leave their last words, a text that ends with a zero byte."""
        return np.ndarray(ECHO_SIZE, np.uint8, self.map, self.offsets(worker)[-2])

    def bell(self, worker: int) -> memoryview:
        """The count of the messages to a worker, as the only element of a view."""
        return np.ndarray(1, _BELL, self.map, self.offsets(worker)[-1]).data

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
