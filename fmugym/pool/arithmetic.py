"""The arithmetic that Python and numpy expect: round to nearest, and keep subnormal numbers.

An FMU may leave another rounding mode behind, and loading a library that was compiled with
``-ffast-math`` may turn subnormal numbers off. Both would change the last bits of everything that
the thread computes afterwards.
"""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable
from typing import Any, Final

__all__ = ["restore_arithmetic"]

_ONE: Final[float] = float("1")  # computed, or else the sums below would be constants
_TINY: Final[float] = float("1e-30")
_LEAST_NORMAL: Final[float] = sys.float_info.min


def restore_arithmetic() -> None:
    """Restore the arithmetic after a call of an FMU; takes 0.1 us where nothing has changed."""
    if _ONE + _TINY != _ONE or _ONE - _TINY != _ONE or 0.5 * _LEAST_NORMAL == 0.0:
        _resetter()()


@functools.cache
def _resetter() -> Callable[[], Any]:
    """Make a function that restores the default floating-point environment of this thread."""
    if sys.platform == "win32":
        reset: Callable[[], Any] = ctypes.CDLL("msvcrt")._fpreset
        return reset
    library = ctypes.CDLL(None)
    default = ctypes.c_void_p(-1)  # FE_DFL_ENV of glibc and musl
    if sys.platform == "darwin":
        default = ctypes.c_void_p(ctypes.addressof(ctypes.c_char.in_dll(library, "_FE_DFL_ENV")))
    return functools.partial(library.fesetenv, default)
