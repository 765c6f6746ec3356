"""Covariances of estimates and their confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fmugym.checks import check_number
from fmugym.distributions import Normal
from fmugym.errors import ConfigError
from fmugym.extras import imported
from fmugym.pool.base import FloatArray, MaskArray

__all__ = [
    "Estimate",
    "Inverse",
    "information_inverse",
    "newey_west",
    "normal_distributions",
]

RANK_TOLERANCE = 1e-9
"""Singular values below this fraction of the largest one count as zero."""


class Inverse(NamedTuple):
    """The inverse of an information matrix.

    Attributes:
        matrix: The (pseudo-)inverse of J' J, shape (k, k).
        undetermined: Whether the data leave each parameter undetermined, shape (k,).
    """

    matrix: FloatArray
    undetermined: MaskArray


def information_inverse(jacobian: FloatArray) -> Inverse:
    """Invert J' J by a singular value decomposition of J with columns scaled to length one.

    Args:
        jacobian: The derivatives of the residuals, shape (n, k).
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    safe = np.where(lengths > 0, lengths, 1.0)
    _, values, rows = np.linalg.svd(jacobian / safe, full_matrices=False)
    kept = values > RANK_TOLERANCE * values.max(initial=0.0)
    root = rows[kept] / values[kept, np.newaxis] / safe
    undetermined = (np.abs(rows[~kept]) > 1e-6).any(axis=0) | (lengths == 0)
    return Inverse(root.T @ root, undetermined)


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


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimated values and their uncertainty.

    Attributes:
        values: The values by name.
        covariance: Covariance of the values, in their order, shape (k, k).
        degrees_of_freedom: Degrees of freedom of the confidence intervals.
    """

    values: dict[str, float]
    covariance: FloatArray
    degrees_of_freedom: int

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name; infinite for a value that the data do not determine."""
        errors = np.sqrt(np.diag(self.covariance)).tolist()
        return dict(zip(self.values, errors, strict=True))

    def factor(self, level: float) -> float:
        """Half the width of an interval in standard errors, by Student's t distribution.

        Args:
            level: Probability that an interval covers the true value, between 0 and 1.

        Raises:
            ConfigError: If the level is not between 0 and 1.
        """
        level = check_number("level", level, positive=True)
        if level >= 1.0:
            raise ConfigError(f"level must be less than 1, not {level:g}")
        freedom = self.degrees_of_freedom
        student = imported("scipy.stats", "identification").t
        return float(student.ppf(0.5 + level / 2, freedom))

    def confidence_intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return lower and upper end by name; they may exceed the bounds.

        Raises:
            ConfigError: If the level is not between 0 and 1.
        """
        factor, errors = self.factor(level), self.standard_errors
        return {n: (v - factor * errors[n], v + factor * errors[n]) for n, v in self.values.items()}


def normal_distributions(
    values: Mapping[str, float],
    errors: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
) -> dict[str, Normal]:
    """Return a truncated normal distribution for each estimate.

    Raises:
        ConfigError: If the data do not determine an estimate.
    """
    for name, error in errors.items():
        if not np.isfinite(error):
            raise ConfigError(f"{name!r} has no distribution: the data do not determine it")
    return {name: Normal(v, errors[name], *bounds[name]) for name, v in values.items()}
