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
        separable: Whether to take the separable form.
        largest: The largest root mean square of the numbers of ``mean``.
        largest_sigma: The largest ``sigma``.
        covariance: That of the first candidates where ``sigma`` is 1, shape (n, n); None for the
            identity, with which the separable form begins.

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
        separable: bool = False,
        largest: float = math.inf,
        largest_sigma: float = math.inf,
        covariance: FloatArray | None = None,
    ) -> None:
        self.mean = mean
        self._rng, self._separable, self._rounds = rng, separable, 0
        self._shape, n = (population, mean.size), mean.size
        ranks = math.log((population + 1) / 2) - np.log(np.arange(1, population // 2 + 1))
        self._weights = ranks / ranks.sum()
        self._mass = mass = 1 / (self._weights @ self._weights)
        self._fade = (mass + 2) / (n + mass + 5)
        self._damping = 1 + 2 * max(0.0, math.sqrt((mass - 1) / (n + 1)) - 1) + self._fade
        self._fade_path = (4 + mass / n) / (n + 4 + 2 * mass / n)
        speed = (n + 2) / 3 if separable else 1.0
        self._rate_one = min(1.0, speed * 2 / ((n + 1.3) ** 2 + mass))
        rate = speed * 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass)
        self._rate_many = min(1 - self._rate_one, rate)
        self._path, self._white_path = np.zeros(n), np.zeros(n)
        whole = np.eye(n) if covariance is None else covariance.copy()
        self._covariance: FloatArray = np.ones(n) if separable else whole
        self._axes: FloatArray = np.eye(n)
        self._scales: FloatArray = np.ones(n)
        self._find_axes()
        growth = self._normalize()
        self.sigma, self._limits = growth * sigma, (largest * math.sqrt(n), growth * largest_sigma)

    def ask(self) -> FloatArray:
        """Draw the candidates of a round, shape (population, n)."""
        self._steps = self._drawn() * self._scales
        if not self._separable:
            self._steps = self._steps @ self._axes.T
        return self.mean + self.sigma * self._steps

    def _drawn(self) -> FloatArray:
        """Standard normal numbers; of few candidates, in directions at right angles.

        So they tell more than independent ones, above all if there is noise (H. Wang, M. Emmerich
        and T. Baeck, Evolutionary Computation 27, 2019).
        """
        drawn: FloatArray = self._rng.standard_normal(self._shape)
        if len(drawn) <= self.mean.size:
            axes, triangle = np.linalg.qr(drawn.T)
            signed = np.copysign(np.linalg.norm(drawn, axis=1), np.diagonal(triangle))
            drawn = axes.T * signed[:, None]
        return drawn

    def tell(self, order: npt.NDArray[np.int64]) -> None:
        """Learn from the order of the candidates, the best one first."""
        best, n = self._steps[order[: self._weights.size]], self.mean.size
        step = self._weights @ best
        white = step / self._scales if self._separable else self._whitened(step)
        self._rounds += 1
        self._white_path += self._moved(self._white_path, self._fade, white)
        length = float(np.linalg.norm(self._white_path))
        usual = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
        most = (1.4 + 2 / (n + 1)) * usual * math.sqrt(1 - (1 - self._fade) ** (2 * self._rounds))
        self._path += self._moved(self._path, self._fade_path, step if length < most else 0 * step)
        self._adapt(best, self._fade_path * (2 - self._fade_path) if length >= most else 0.0)
        mean, (norm, sigma) = self.mean + self.sigma * step, self._limits
        self.mean = mean * min(1.0, norm / max(float(np.linalg.norm(mean)), 1e-300))
        growth = min(1.0, self._fade / self._damping * (length / usual - 1))
        self.sigma = min(self.sigma * math.exp(growth) * self._normalize(), sigma)

    def _whitened(self, step: FloatArray) -> FloatArray:
        found: FloatArray = self._axes @ (step @ self._axes / self._scales)
        return found

    def _moved(self, path: FloatArray, fade: float, step: FloatArray) -> FloatArray:
        return math.sqrt(fade * (2 - fade) * self._mass) * step - fade * path

    def _normalize(self) -> float:
        """Divide steps by their size, which else would grow beside ``sigma``, and return it."""
        variances = self._covariance if self._separable else np.diagonal(self._covariance)
        size = math.sqrt(float(variances.mean()))
        self._covariance /= size**2
        self._scales, self._path = self._scales / size, self._path / size
        return size

    def _adapt(self, best: FloatArray, missing: float) -> None:
        """Adapt the covariances; ``missing`` makes up for a path that stood still."""
        kept = 1 - self._rate_one * (1 - missing) - self._rate_many
        if self._separable:
            added = self._rate_many * (self._weights @ best**2) + self._rate_one * self._path**2
            self._covariance = kept * self._covariance + added
            self._find_axes()
            return
        many = self._rate_many * (best.T * self._weights) @ best
        one = self._rate_one * np.outer(self._path, self._path)
        self._covariance = kept * self._covariance + many + one
        if self._rounds % max(1, self.mean.size // 20) == 0:
            self._find_axes()

    def _find_axes(self) -> None:
        """Find the axes of the candidates, and the length of each."""
        if self._separable:
            self._scales = np.sqrt(self._covariance)
        else:
            values, self._axes = np.linalg.eigh(self._covariance)
            self._scales = np.sqrt(np.maximum(values, 1e-300))
