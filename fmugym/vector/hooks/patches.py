"""Functions of numpy that do not ask their arguments: they are replaced while hooks are traced."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np

from fmugym.expressions.graph import Graph
from fmugym.vector.hooks import tables
from fmugym.vector.hooks.functions import COMPOSED, full_like
from fmugym.vector.hooks.symbols import LANES, as_symbols, has_symbols, lift

__all__ = ["exclusive", "numpy_of"]

_array_function, _full_function, _empty_function = np.array, np.full, np.empty

_tracing = threading.local()
"""Has the ``graph`` that this thread records, if any."""

exclusive: Final = threading.RLock()
"""Keeps other threads from tracing. They would find what stands in the place of tables."""


def _patched(function: Any, own: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **keywords: Any) -> Any:
        graph = getattr(_tracing, "graph", None)
        if graph is None:
            return function(*args, **keywords)
        return own(graph, function, *args, **keywords)

    return functools.update_wrapper(call, function)


# What takes the place of numpy's functions: each gets the graph, the function and its arguments.


def _array(
    graph: Graph, function: Any, value: Any, dtype: Any = None, *args: Any, **kw: Any
) -> Any:
    if not has_symbols(value):
        return _tabulated(graph, function, value, dtype, *args, **kw)
    symbols = as_symbols(graph, value)
    wanted = symbols.dtype if dtype is None else np.dtype(dtype)
    is_new = function is _array_function or symbols.dtype != wanted
    return symbols.cast(wanted).copy() if is_new else symbols


def _made(graph: Graph, function: Any, shape: Any, *args: Any, **keywords: Any) -> Any:
    if function is _full_function and has_symbols(args[:1]):
        dtype = keywords.get("dtype", args[1] if len(args) > 1 else None)
        return full_like(np.zeros(shape), args[0], dtype or as_symbols(graph, args[0]).dtype)
    array = function(shape, *args, **keywords)
    if function is _empty_function:
        array[...] = 0
    is_of_all = array.shape[-1:] == (LANES,) and array.dtype.kind in "biuf"
    return lift(graph, array) if is_of_all else array


def _tabulated(graph: Graph, function: Any, *args: Any, **keywords: Any) -> Any:
    array = function(*args, **keywords)
    return array.view(tables.Table) if tables.is_table(array) and array.ndim else array


def _looked_up(graph: Graph, function: Any, *args: Any, **keywords: Any) -> Any:
    if has_symbols(args) or has_symbols(list(keywords.values())):
        return tables.FUNCTIONS[function](*args, **keywords)
    return function(*args, **keywords)


def _of_list(graph: Graph, function: Any, a: Any, *args: Any, **keywords: Any) -> Any:
    is_list = isinstance(a, list | tuple) and has_symbols(a)
    return function(as_symbols(graph, a) if is_list else a, *args, **keywords)


_OVERRIDING: Final[Mapping[str, Any]] = {
    **dict.fromkeys(("array", "asarray", "asanyarray", "ascontiguousarray"), _array),
    **dict.fromkeys(("zeros", "ones", "full", "empty"), _made),
    **dict.fromkeys(("linspace", "arange"), _tabulated),
    **{function.__name__: _looked_up for function in tables.FUNCTIONS},
    **{function.__name__: _of_list for function in COMPOSED},
    **dict.fromkeys(("transpose", "reshape", "ravel", "flip", "roll", "moveaxis"), _of_list),
    **dict.fromkeys(("argmax", "argmin", "dot", "cross", "inner"), _of_list),
}
"""What each function does with symbols, by its name."""

_PATCHES: Final[Sequence[Any]] = [
    *((np, name, _patched(getattr(np, name), own)) for name, own in _OVERRIDING.items()),
    (np.linalg, "norm", _patched(np.linalg.norm, _of_list)),
]


@contextmanager
def numpy_of(graph: Graph) -> Iterator[None]:
    """Let functions of numpy that do not ask their arguments return symbols, in this thread.

    ``numpy.array`` and a few others cannot be overridden by their arguments, or not by those in
    a list. So they are replaced while hooks are traced. In other threads they do what they always
    do.
    """
    with exclusive:
        try:
            for module, name, function in _PATCHES:
                setattr(module, name, function)
            _tracing.graph = graph
            yield
        finally:
            _tracing.graph = None
            for module, name, function in _PATCHES:
                setattr(module, name, function.__wrapped__)
