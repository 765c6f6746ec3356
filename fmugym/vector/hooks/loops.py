"""numpy's own inner loops, for what IEEE 754 does not settle.

numpy computes sines and powers with loops that differ from the C library's functions in the last
bits. It hands these loops out to compilers. So a program calls them, and its results are numpy's.
"""

from __future__ import annotations

import functools
import math
import platform
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.pool import ufuncs
from fmugym.vector.hooks.program import UntraceableError

__all__ = ["has_known_sines", "loop_of", "squares_nearly_exactly"]


def loop_of(ufunc: np.ufunc, types: tuple[np.dtype[Any], ...]) -> Any:
    """The capsule with numpy's loop for inputs and output of these types.

    Raises:
        UntraceableError: If this numpy does not hand it out, or it needs the interpreter.
    """
    try:
        return ufuncs.loop_of(ufunc, types)
    except ufuncs.LoopError as error:
        raise UntraceableError(str(error)) from error


@functools.cache
def squares_nearly_exactly() -> bool:
    """Whether squares by ``numpy.float_power`` have an error below 0.515 units in the last place.

    They are those of the C library's ``pow``. That of glibc has an error of at most 0.511 units,
    plus a part that is below 0.001 units for squares between 2^-32 and 2^32, since version 2.28
    (``sysdeps/ieee754/dbl-64/e_pow.c``). A sample shows whether numpy calls it.
    """
    if not _has_known_library():
        return False
    values = np.random.default_rng(0).uniform(-8.0, 8.0, 20_000)
    return bool(_is_within(np.float_power(values, 2.0), values, 0.515))


@functools.cache
def has_known_sines() -> bool:
    """Whether numpy's sines and cosines have an error of less than 0.55 units in the last place.

    Those of glibc have, since version 2.28 (``sysdeps/ieee754/dbl-64/s_sin.c``). A sample shows
    whether numpy calls them, as Python does. See ``native/sines.c``.
    """
    if not _has_known_library():
        return False
    values = np.random.default_rng(0).uniform(-30.0, 30.0, 5_000)
    own = [[math.sin(value), math.cos(value)] for value in values.tolist()]
    return bool(np.array_equal(np.stack([np.sin(values), np.cos(values)], axis=1), own))


def _has_known_library() -> bool:
    library, version = platform.libc_ver()
    numbers = [int(part) for part in version.split(".") if part.isdigit()]
    return library == "glibc" and numbers >= [2, 28]


def _is_within(
    powers: npt.NDArray[np.float64], values: npt.NDArray[np.float64], most: float
) -> np.bool_:
    """Whether powers differ from exact squares by at most so many units in the last place."""
    shifted = values * 134217729.0
    high = shifted - (shifted - values)
    low, rounded = values - high, values * values
    rest = ((high * high - rounded) + 2.0 * high * low) + low * low  # Dekker's product
    return (np.abs((powers - rounded) - rest) <= most * np.spacing(rounded)).all()
