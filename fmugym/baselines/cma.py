"""Covariance matrix adaptation: a search for vectors of numbers that needs only their order."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

__all__ = ["CMA"]

FloatArray = npt.NDArray[np.float64]


class CMA:
    """An evolution strategy that adapts its steps (N. Hansen, arXiv:1604.00772).

    The separable form adapts a variance for each number and no covariances (R. Ros and N. Hansen,
    Parallel Problem Solving from Nature X, 2008). It learns faster where there are many numbers.

    Args:
        mean: Where the search begins, shape (n,).
        sigma: The standard deviation of the first candidates.
        population: The candidates of a round.
        rng: Draws them.
        covariance: That of the first candidates where ``sigma`` is 1, shape (n, n); shape (n,) with
            variances for the separable form. None for the identity, shape (n, n).
        largest: The largest root mean square of the numbers of ``mean``.
        largest_sigma: The largest ``sigma``.

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
        covariance: FloatArray | None = None,
        *,
        largest: float = math.inf,
        largest_sigma: float = math.inf,
    ) -> None:
        n = mean.size
        self.mean, self._rng, self._shape = mean, rng, (population, n)
        self._covariance = np.eye(n) if covariance is None else covariance
        ranks = math.log((population + 1) / 2) - np.log(np.arange(1, population // 2 + 1))
        self._weights = ranks / ranks.sum()
        self._mass = mass = 1 / (self._weights @ self._weights)
        self._fade = (mass + 2) / (n + mass + 5)
        self._damping = 1 + 2 * max(0.0, math.sqrt((mass - 1) / (n + 1)) - 1) + self._fade
        self._fade_path = (4 + mass / n) / (n + 4 + 2 * mass / n)
        speed = (n + 2) / 3 if self._is_separable else 1.0
        self._rate_one = min(1.0, speed * 2 / ((n + 1.3) ** 2 + mass))
        rate = speed * 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass)
        self._rate_many = min(1 - self._rate_one, rate)
        self._path, self._white_path = np.zeros(n), np.zeros(n)
        self._usual_length = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
        size = self._find_root()
        self.sigma, self._limits = size * sigma, (largest * math.sqrt(n), size * largest_sigma)

    @property
    def _is_separable(self) -> bool:
        return self._covariance.ndim == 1

    def ask(self) -> FloatArray:
        """Draw the candidates of a round, shape (population, n)."""
        self._white = white = self._drawn()
        self._steps = white * self._root if self._is_separable else white @ self._root
        return self.mean + self.sigma * self._steps

    def _drawn(self) -> FloatArray:
        """Standard normal numbers; of few candidates, in directions at right angles.

        So they tell more than independent ones, above all if there is noise (H. Wang, M. Emmerich
        and T. Baeck, Evolutionary Computation 27, 2019).
        """
        drawn: FloatArray = self._rng.standard_normal(self._shape)
        if len(drawn) <= self.mean.size:
            axes, triangle = np.linalg.qr(drawn.T)
            lengths = np.copysign(np.linalg.norm(drawn, axis=1), np.diagonal(triangle))
            drawn = (axes * lengths).T
        return drawn

    def tell(self, order: npt.NDArray[np.int64]) -> None:
        """Learn from the order of the candidates, the best one first."""
        chosen = order[: self._weights.size]
        best, white = self._steps[chosen], self._weights @ self._white[chosen]
        step = self._weights @ best
        mean, (norm, sigma) = self.mean + self.sigma * step, self._limits
        self.mean = mean * min(1.0, norm / max(float(np.linalg.norm(mean)), 1e-300))
        self._path = self._followed(self._path, self._fade_path, step)
        self._white_path = self._followed(self._white_path, self._fade, white)
        length = float(np.linalg.norm(self._white_path)) / self._usual_length
        self._adapt(best)
        growth = math.exp(min(1.0, self._fade / self._damping * (length - 1)))
        self.sigma = min(growth * self.sigma * self._find_root(), sigma)

    def _followed(self, path: FloatArray, fade: float, step: FloatArray) -> FloatArray:
        return (1 - fade) * path + math.sqrt(fade * (2 - fade) * self._mass) * step

    def _adapt(self, best: FloatArray) -> None:
        many = self._weights @ best**2 if self._is_separable else (best.T * self._weights) @ best
        one = self._path**2 if self._is_separable else np.outer(self._path, self._path)
        kept = 1 - self._rate_one - self._rate_many
        self._covariance = kept * self._covariance + self._rate_many * many + self._rate_one * one

    def _find_root(self) -> float:
        """Find what turns normal numbers into steps.

        Returns:
            The size of steps, by which they are divided; else it would grow beside ``sigma``.
        """
        if self._is_separable:
            self._root = np.sqrt(self._covariance)
        else:
            values, axes = np.linalg.eigh(self._covariance)
            self._root = (axes * np.sqrt(np.maximum(values, 1e-300))) @ axes.T
        size = float(np.linalg.norm(self._root)) / math.sqrt(self.mean.size)
        self._root, self._path = self._root / size, self._path / size
        self._covariance = self._covariance / size**2
        return size
