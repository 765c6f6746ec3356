"""Draws that the C extension makes: from random streams, and by generators of numpy."""

from __future__ import annotations

import ctypes
import functools
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmugym.distributions import Recipe
from fmugym.pool.form import form_of_draws

if TYPE_CHECKING:
    from fmugym._native import Draws

__all__ = ["native_draws", "no_draws"]


def native_draws(recipes: Sequence[Recipe] | None, rows: Sequence[int]) -> Draws | None:
    """Prepare draws.

    Args:
        recipes: How each value is drawn; None if only Python can do it.
        rows: For each, the row of the start value that it sets, or -1.

    Returns:
        None if the C extension cannot make one of the draws.
    """
    if recipes is None:
        return None
    needed = {"normal": _standard_normal, "log_uniform": _exponential}
    if any(recipe.kind in needed and not needed[recipe.kind]() for recipe in recipes):
        return None
    return _draws(tuple(recipes), tuple(rows))


def no_draws() -> Draws:
    """Draws that are none, because Python starts the episodes."""
    return _draws((), ())


@functools.lru_cache(64)
def _draws(recipes: tuple[Recipe, ...], rows: tuple[int, ...]) -> Draws:
    from fmugym import _native

    known = _native.distributions()
    counts = [len(recipe.numbers) for recipe in recipes]
    firsts = np.cumsum([0, *counts])[:-1]
    columns = [known.index(recipe.kind) for recipe in recipes], rows, firsts, counts
    table = np.array(columns, np.int64).reshape(4, -1).T
    numbers = np.array([number for recipe in recipes for number in recipe.numbers])
    return _native.Draws(form_of_draws(table, numbers), _standard_normal(), _exponential())


@functools.cache
def _standard_normal() -> int:
    """The address of numpy's function for normal distributions; 0 if it cannot be found.

    numpy's documentation, "Extending via CFFI", finds the functions of its ``distributions.h`` in
    the same way. It keeps the values those of the numpy at hand.
    """
    return _address(np.random._generator.__file__, "random_standard_normal")


@functools.cache
def _exponential() -> int:
    """The address of the C library's ``exp``, which ``math.exp`` calls; 0 if it cannot be found."""
    if sys.platform == "win32":
        return _address("ucrtbase", "exp")
    return _address(getattr(math, "__file__", None), "exp")  # or it is a part of Python itself


def _address(library: str | None, name: str) -> int:
    try:
        function = getattr(ctypes.CDLL(library), name)
    except (AttributeError, OSError):  # the system does not export it
        return 0
    return ctypes.cast(function, ctypes.c_void_p).value or 0
