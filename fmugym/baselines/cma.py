"""Covariance matrix adaptation: a search for vectors of numbers that needs only their order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.pool.base import FloatArray

__all__ = ["CMA", "MOST_CORRELATED"]


MOST_CORRELATED: Final = 200
"""More numbers than these are searched without covariances."""

_STATE: Final = ("mean", "sigma", "_limits", "_covariance", "_root", "_paths")


class CMA:
    """An evolution strategy that adapts its steps (N. Hansen, arXiv:1604.00772).

    Where there are many numbers, it takes the separable form, which adapts a variance for each of
    them and no covariances, and so learns faster (R. Ros and N. Hansen, Parallel Problem Solving
    from Nature X, 2008).

    Args:
        mean: Where the search begins, shape (n,).
        sigma: The standard deviation of the first candidates.
        population: The candidates of a round.
        rng: Draws them.
        largest: The largest root mean square of the numbers of ``mean``.
        growth: ``sigma`` becomes so many times as large as the first one, at most.

    Attributes:
        mean: The best guess until now, shape (n,).
        sigma: The present length of steps: the root mean square of their standard deviations.
    """

    def __init__(
        self,
        mean: FloatArray,
        sigma: float,
        population: int,
        rng: np.random.Generator,
        *,
        largest: float = math.inf,
        growth: float = math.inf,
    ) -> None:
        n = mean.size
        self.mean, self.sigma, self._rng, self._shape = mean, sigma, rng, (population, n)
        self._limits = largest * math.sqrt(n), growth * sigma
        self._is_separable = n > MOST_CORRELATED
        self._covariance = np.ones(n) if self._is_separable else np.eye(n)
        self._root = self._covariance
        ranks = math.log((population + 1) / 2) - np.log(np.arange(1, population // 2 + 1))
        self._weights = ranks / ranks.sum()
        mass = 1 / (self._weights @ self._weights)
        fade = (mass + 2) / (n + mass + 5)
        damping = 1 + 2 * max(0.0, math.sqrt((mass - 1) / (n + 1)) - 1) + fade
        self._pace = fade / damping
        self._fades = np.array([[(4 + mass / n) / (n + 4 + 2 * mass / n)], [fade]])
        self._gains = np.sqrt(self._fades * (2 - self._fades) * mass)
        self._paths = np.zeros((2, n))
        speed = (n + 2) / 3 if self._is_separable else 1.0
        self._rate_one = speed * 2 / ((n + 1.3) ** 2 + mass)
        rate = speed * 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass)
        self._rate_many = min(1 - self._rate_one, rate)
        self._usual_length = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))

    def state(self) -> dict[str, Any]:
        """State of the search, from which the next round follows: numbers and arrays by name."""
        return {"population": self._shape[0], **{name: getattr(self, name) for name in _STATE}}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a state of a search with as many numbers and candidates.

        Raises:
            KeyError: If something is missing.
            TypeError, ValueError: If something has another form.
        """
        for name in _STATE:
            now, given = np.asarray(getattr(self, name)), np.asarray(state[name], np.float64)
            if given.shape != now.shape or np.isnan(given).any():
                raise ValueError(f"{name} has the shape {given.shape}, expected {now.shape}")
            setattr(self, name, given if given.ndim else float(given))
        if not self.sigma > 0.0:
            raise ValueError(f"sigma is {self.sigma}")

    def ask(self) -> FloatArray:
        """Draw the candidates of a round, shape (population, n).

        Half of them mirror the others: so they tell more than independent ones. Of a pair only the
        better one counts: two would cancel, and steps become shorter by chance (A. Auger, D.
        Brockhoff and N. Hansen, Genetic and Evolutionary Computation Conference, 2011).
        """
        count, n = self._shape
        half = self._rng.standard_normal(((count + 1) // 2, n))
        self._white = white = np.concatenate([half, -half])[:count]
        self._steps = white * self._root if self._is_separable else white @ self._root
        candidates: FloatArray = self.mean + self.sigma * self._steps
        return candidates

    def tell(self, order: npt.NDArray[np.int64]) -> None:
        """Learn from the order of the candidates, the best one first."""
        _, places = np.unique(order % ((len(order) + 1) // 2), return_index=True)
        chosen = order[np.sort(places)][: self._weights.size]
        best, white = self._steps[chosen], self._weights @ self._white[chosen]
        step = self._weights @ best
        mean, (norm, sigma) = self.mean + self.sigma * step, self._limits
        self.mean = mean * min(1.0, norm / max(float(np.linalg.norm(mean)), 1e-300))
        self._paths = (1 - self._fades) * self._paths + self._gains * np.stack([step, white])
        length = float(np.linalg.norm(self._paths[1])) / self._usual_length
        growth = math.exp(min(1.0, self._pace * (length - 1)))
        self.sigma = min(growth * self.sigma * self._adapted(best), sigma)

    def _adapted(self, best: FloatArray) -> float:
        """Adapt the covariance, and factorize it for the next steps.

        Returns:
            The size of steps, by which they are divided; else it would grow beside ``sigma``.
        """
        many = self._weights @ best**2 if self._is_separable else (best.T * self._weights) @ best
        path = self._paths[0]
        one = path**2 if self._is_separable else np.outer(path, path)
        kept = 1 - self._rate_one - self._rate_many
        covariance = kept * self._covariance + self._rate_many * many + self._rate_one * one
        if self._is_separable:
            root = np.sqrt(covariance)
        else:
            values, axes = np.linalg.eigh(covariance)
            root = (axes * np.sqrt(np.maximum(values, 1e-300))) @ axes.T
        size = float(np.linalg.norm(root)) / math.sqrt(self.mean.size)
        self._root, self._covariance = root / size, covariance / size**2
        self._paths[0] /= size
        return size
