"""The inner loops of numpy's functions, which numpy hands out to compilers."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmugym.pool.extension import has_native_pool
from fmugym.signals import ordinary

if has_native_pool():
    from fmugym import _native

__all__ = ["LoopError", "Source", "loop_of", "source_of"]

Source = tuple[Any, tuple[np.dtype[Any], ...]]
"""A function and the types of its inputs and its output."""

_loops: dict[Source, Any] = {}
"""The capsules. They stay alive with the process."""


class LoopError(Exception):
    """There is no loop that the C code could call."""


def loop_of(ufunc: np.ufunc, types: tuple[np.dtype[Any], ...]) -> Any:
    """The capsule with numpy's loop for inputs and output of these types.

    Raises:
        LoopError: If this numpy does not hand it out, or it needs the interpreter.
    """
    key = ufunc, types
    if key not in _loops:
        _loops[key] = _resolved(ufunc, types)
    return _loops[key]


def source_of(capsule: Any) -> Source:
    """What ``loop_of`` has made a capsule of, for another process, which needs its own."""
    return next(source for source, own in _loops.items() if own is capsule)


def _resolved(ufunc: Any, types: tuple[np.dtype[Any], ...]) -> Any:
    try:
        found, capsule = ufunc._resolve_dtypes_and_context(types)
        ufunc._get_strided_loop(capsule)
    except ordinary(Exception) as error:  # the two methods are experimental
        raise LoopError(f"numpy hands out no loop of {ufunc.__name__}") from error
    if tuple(found) != types or not _native.is_free_loop(capsule):
        raise LoopError(f"numpy.{ufunc.__name__} needs the interpreter")
    return capsule
