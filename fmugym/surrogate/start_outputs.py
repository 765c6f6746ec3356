"""Outputs at the start of episodes, as functions of the values that are set before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.expressions.value import Value
from fmugym.pool.base import FloatArray
from fmugym.surrogate.courses import Course

__all__ = ["Start"]

_PENALTY: Final = 1e-8
_BEYOND: Final = 0.5
"""Outputs begin in their range in the courses, which is so much wider on both sides."""


@dataclass(frozen=True)
class Start:
    """Outputs at the start of an episode, as a sum of terms of the start values.

    Attributes:
        names: The variables that are set.
        mean, deviation: Mean and standard deviation of their values, shape (p,).
        low, high: The range of the outputs, shape (k,).
        weights: Weights of the terms, shape (k, f).
    """

    names: tuple[str, ...]
    mean: FloatArray
    deviation: FloatArray
    low: FloatArray
    high: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, variables: Sequence[Variable], courses: Sequence[Course]) -> Start:
        """The fit to the starts of courses, equal ones once."""
        several = list({one.starts.tobytes(): one for one in courses}.values())
        given = np.array([one.starts for one in several])
        first = np.array([one.outputs[0] for one in several])
        deviation = given.std(axis=0)
        names = tuple(one.name for one in variables)
        beyond = _BEYOND * np.ptp(first, axis=0)
        low, high = first.min(axis=0) - beyond, first.max(axis=0) + beyond
        about = names, given.mean(axis=0), deviation, low, high
        terms = cls(*about, np.zeros(0))._terms(given.T)
        square = terms @ terms.T / len(given) + _PENALTY * np.eye(len(terms))
        return cls(*about, np.linalg.solve(square, terms @ first / len(given)).T)

    def _terms(self, given: FloatArray) -> FloatArray:
        """Shape (f, n): 1, the scaled values that differ, and their products."""
        differ = self.deviation > 0.0
        scaled = ((given.T - self.mean) / np.where(differ, self.deviation, 1.0)).T[differ]
        first, second = np.triu_indices(len(scaled))
        ones = np.ones((1, given.shape[1]))
        return np.concatenate([ones, scaled, scaled[first] * scaled[second]])

    def values(self, given: Sequence[Value]) -> list[Value]:
        """Outputs as values of a graph, from the start values."""
        scaled = [
            (one - mean) * (1.0 / deviation)
            for one, mean, deviation in zip(given, self.mean, self.deviation, strict=True)
            if deviation > 0.0
        ]
        products = [one * two for place, one in enumerate(scaled) for two in scaled[place:]]
        found = []
        for (constant, *weights), low, high in zip(self.weights, self.low, self.high, strict=True):
            total: Any = given[0].beside(float(constant))
            for weight, one in zip(weights, [*scaled, *products], strict=True):
                total = total + one * float(weight)
            found.append(np.minimum(np.maximum(total, float(low)), float(high)))
        return found

    def outputs(self, given: FloatArray) -> FloatArray:
        """The outputs, shape (k, n), from values of shape (p, n)."""
        return np.clip((self.weights @ self._terms(given)).T, self.low, self.high).T
