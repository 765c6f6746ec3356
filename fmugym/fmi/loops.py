"""Solving x = y(x) for the values of the links of an algebraic loop.

This is the arithmetic of ``native/loops.c``, operation by operation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from fmugym.systems.plan import Loop

__all__ = ["NotSolvedError", "solve_loop"]

_NUDGE: Final = 2.0**-14
"""How far an unknown moves to see what depends on it; see ``NUDGE`` there."""

Vector = list[float]


class NotSolvedError(Exception):
    """A loop has no solution within its tolerance after its most iterations."""


def solve_loop(loop: Loop, x: Vector, evaluate: Callable[[Vector], Vector]) -> None:
    """Solve a loop; ends right after an evaluation that agrees with its x.

    Args:
        loop: The method.
        x: Where to begin; afterwards the solution.
        evaluate: Computes y of x.

    Raises:
        NotSolvedError: If there is no solution.
    """
    for _ in range(loop.max_iterations):
        y = evaluate(x)
        if _agree(loop, x, y):
            return
        x[:] = _improved(x, y, evaluate) if loop.method == "newton" else y
    raise NotSolvedError


def _agree(loop: Loop, x: Vector, y: Vector) -> bool:
    pairs = zip(x, y, strict=True)
    return all(abs(b - a) <= loop.tolerance * max(1.0, abs(b)) for a, b in pairs)


def _improved(x: Vector, y: Vector, evaluate: Callable[[Vector], Vector]) -> Vector:
    """Take a step of Newton's method, or go to y where there is none."""
    matrix = _differentiated(x, y, evaluate)
    step = [b - a for a, b in zip(x, y, strict=True)]
    if not _solve_linear(matrix, step):
        return list(y)
    triples = zip(x, step, y, strict=True)
    return [a + d if math.isfinite(d) else b for a, d, b in triples]


def _differentiated(x: Vector, y: Vector, evaluate: Callable[[Vector], Vector]) -> list[Vector]:
    """The matrix of x - y(x), differentiated by x."""
    n = len(x)
    matrix = [[0.0] * n for _ in range(n)]
    for j in range(n):
        here = x[j]
        x[j] = here + _NUDGE * max(1.0, abs(here))
        distance = x[j] - here
        moved = evaluate(x)
        x[j] = here
        for i in range(n):
            matrix[i][j] = (1.0 if i == j else 0.0) - (moved[i] - y[i]) / distance
    return matrix


def _solve_linear(matrix: list[Vector], right: Vector) -> bool:
    """Gaussian elimination; the solution takes the place of the right side."""
    n = len(right)
    for k in range(n):
        best = _largest_of_column(matrix, k)
        matrix[k], matrix[best] = matrix[best], matrix[k]
        right[k], right[best] = right[best], right[k]
        if not abs(matrix[k][k]) > 0.0:
            return False
        for i in range(k + 1, n):
            factor = matrix[i][k] / matrix[k][k]
            for j in range(k, n):
                matrix[i][j] -= factor * matrix[k][j]
            right[i] -= factor * right[k]
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            right[k] -= matrix[k][j] * right[j]
        right[k] /= matrix[k][k]
    return True


def _largest_of_column(matrix: list[Vector], column: int) -> int:
    best = column
    for i in range(column + 1, len(matrix)):
        if abs(matrix[i][column]) > abs(matrix[best][column]):
            best = i
    return best
