"""How much memory this process takes, and how much of its heap is in use."""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from collections.abc import Callable
from typing import Any, Final

__all__ = ["grown_bytes", "heap_bytes", "memory_is_known"]

_PAGE_SIZE: Final = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 0


def memory_is_known() -> bool:
    """Whether this system tells how much memory a process takes."""
    return sys.platform != "win32"


def grown_bytes() -> int:
    """The memory that this process takes, without the pages of files.

    On other systems than Linux it is the most that the process has ever taken.
    """
    if sys.platform == "linux":
        with open("/proc/self/statm", "rb", buffering=0) as file:
            _, resident, shared, *_ = file.read(80).split()
        return (int(resident) - int(shared)) * _PAGE_SIZE
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


class _MallInfo(ctypes.Structure):
    """What ``mallinfo2`` of glibc returns."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    )


@functools.cache
def _mallinfo() -> Callable[[], Any] | None:
    if sys.platform == "win32":
        return None
    function = getattr(ctypes.CDLL(None), "mallinfo2", None)  # since glibc 2.33
    if function is not None:
        function.restype = _MallInfo
    return function


def heap_bytes() -> int:
    """The memory that was allocated and not freed; ``grown_bytes`` where nobody tells.

    Freed memory seldom goes back to the system, so ``grown_bytes`` does not show that it was freed.
    This function takes from a microsecond to some milliseconds where the heap is fragmented.
    """
    function = _mallinfo()
    if function is None:
        return grown_bytes()
    info = function()
    return int(info.uordblks + info.hblkhd)
