"""Statistics of residuals: information, covariances and correlation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmugym.extras import imported
from fmugym.pool.base import FloatArray

__all__ = ["Correlation", "memory_of", "newey_west", "sandwich"]

_RANK_TOLERANCE = 1e-9
"""Singular values below this fraction of the largest one count as zero."""

_FALSE_ALARM = 1e-3
"""Share of white noise that counts as correlated."""

ROUNDING = 1e-6
"""Residuals below this, in units of their scale, are rounding errors."""

_MOST_LAGS = 20
"""Of the autocorrelations that the test for white noise looks at."""


def sandwich(jacobian: FloatArray, scores: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of an estimate, and the information: its inverse; shapes (k, k).

    A singular value decomposition of J with columns scaled to length one shows the directions of
    which the data tell nothing. The information is 0 along them, and the variance of a parameter
    that changes along them is infinite.

    Args:
        jacobian: The derivatives J of the residuals r, shape (n, k).
        scores: The covariance of J' r, shape (k, k).
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    safe = np.where(lengths > 0, lengths, 1.0)
    _, values, rows = np.linalg.svd(jacobian / safe, full_matrices=False)
    kept = values > _RANK_TOLERANCE * values.max(initial=0.0)
    told, bread = rows[kept], values[kept, np.newaxis] ** 2
    middle = (told / safe) @ scores @ (told / safe).T
    narrow, wide = told / bread / safe, told * bread * safe
    covariance = narrow.T @ middle @ narrow
    unknown = np.flatnonzero((np.abs(rows[~kept]) > 1e-6).any(axis=0) | (lengths == 0))
    covariance[unknown, unknown] = np.inf
    information = wide.T @ np.linalg.pinv(middle, _RANK_TOLERANCE, hermitian=True) @ wide
    return covariance, information


class Correlation(NamedTuple):
    """Correlation of the residuals of an output with earlier ones.

    Attributes:
        first: The correlation with the residual one sample before.
        is_noise: Whether correlations up to the 20th sample before are no larger than those of
            white noise, by the test of Ljung and Box, "On a measure of lack of fit in time series
            models", Biometrika 65 (1978).
    """

    first: float
    is_noise: bool

    @classmethod
    def of(cls, residuals: Sequence[FloatArray]) -> Correlation:
        """Judge the residuals of an output, an array (n,) for each experiment."""
        count = sum(map(len, residuals))
        lags = range(1, 1 + min(_MOST_LAGS, max(map(len, residuals)) - 1))
        power = sum(float(one @ one) for one in residuals)
        if not lags or power <= count * ROUNDING**2:
            return cls(0.0, True)
        found = [sum(float(one[lag:] @ one[:-lag]) for one in residuals) / power for lag in lags]
        statistic = (
            count
            * (count + 2)
            * sum(one**2 / (count - lag) for one, lag in zip(found, lags, strict=True))
        )
        chi2 = imported("scipy.stats", "identification").chi2
        return cls(found[0], bool(statistic <= chi2.ppf(1 - _FALSE_ALARM, len(lags))))


def memory_of(correlation: float, count: int) -> int:
    """Choose the lags of ``newey_west`` for a process of first order.

    Andrews, "Heteroskedasticity and autocorrelation consistent covariance matrix estimation",
    Econometrica 59 (1991).

    Args:
        correlation: Between neighbouring samples.
        count: The number of samples.
    """
    slow = min(max(correlation, 0.0), 0.99)
    return 1 + int(1.1447 * (4 * slow**2 / (1 - slow**2) ** 2 * count) ** (1 / 3))


def newey_west(scores: Sequence[FloatArray], lags: int) -> FloatArray:
    """Sum the scores' autocovariances with Bartlett's weights.

    Newey and West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation
    consistent covariance matrix", Econometrica 55 (1987).

    Args:
        scores: Regressors times residuals, an array (n, k) for each experiment.
        lags: The largest lag with a weight above 0, in samples.

    Returns:
        The covariance of the sum of the scores, shape (k, k).
    """
    total = sum(score.T @ score for score in scores)
    for lag in range(1, lags + 1):
        crossed = sum(score[lag:].T @ score[:-lag] for score in scores if len(score) > lag)
        total = total + (1 - lag / (lags + 1)) * (crossed + np.transpose(crossed))
    return np.asarray(total)
