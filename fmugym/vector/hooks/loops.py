"""numpy's own inner loops, for what IEEE 754 does not settle.

numpy computes sines and powers with loops that differ from the C library's functions in the last
bits. It hands these loops out to compilers. So a program calls them, and its results are numpy's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmugym.pool.extension import has_native_pool
from fmugym.vector.hooks.program import UntraceableError

if has_native_pool():
    from fmugym import _native

__all__ = ["loop_of"]

_loops: dict[tuple[Any, tuple[Any, ...]], Any] = {}
"""The capsules by function and types. They stay alive with the process."""


def loop_of(ufunc: np.ufunc, types: tuple[np.dtype[Any], ...]) -> Any:
    """The capsule with numpy's loop for inputs and output of these types.

    Raises:
        UntraceableError: If this numpy does not hand it out, or it needs the interpreter.
    """
    key = ufunc, types
    if key not in _loops:
        _loops[key] = _resolved(ufunc, types)
    return _loops[key]


def _resolved(ufunc: Any, types: tuple[np.dtype[Any], ...]) -> Any:
    try:
        found, capsule = ufunc._resolve_dtypes_and_context(types)
        ufunc._get_strided_loop(capsule)
    except Exception as error:  # the two methods are experimental
        raise UntraceableError(f"numpy hands out no loop of {ufunc.__name__}") from error
    if tuple(found) != types or not _native.is_free_loop(capsule):
        raise UntraceableError(f"numpy.{ufunc.__name__} needs the interpreter")
    return capsule
