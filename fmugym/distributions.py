"""Distributions from which an environment draws values at each reset.

Wherever a config takes a number for a start value, a parameter or an episode variable it also
takes a distribution, and the environment draws from it with its own seeded generator.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any, Protocol

import numpy as np

from fmugym.errors import ConfigError

__all__ = ["Choice", "Distribution", "LogUniform", "Normal", "Uniform", "draw", "is_distribution"]


class Distribution(Protocol):
    """Anything with ``sample(rng)``; frozen ``scipy.stats`` distributions are taken as well."""

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value with the given generator."""
        ...


@dataclass(frozen=True)
class Uniform:
    """The uniform distribution over ``[low, high)``, drawn as ``rng.uniform(low, high)``."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _require_finite(self, self.low, self.high)
        if self.low > self.high:
            raise ConfigError(f"{self}: low must not be greater than high")

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value."""
        return float(rng.uniform(self.low, self.high))


@dataclass(frozen=True)
class LogUniform:
    """The distribution whose logarithm is uniform; ``0 < low <= high``."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _require_finite(self, self.low, self.high)
        if not 0 < self.low <= self.high:
            raise ConfigError(f"{self}: the bounds must satisfy 0 < low <= high")

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value."""
        return math.exp(rng.uniform(math.log(self.low), math.log(self.high)))


@dataclass(frozen=True)
class Normal:
    """The normal distribution, redrawn until the value lies in ``[low, high]``."""

    mean: float
    std: float
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        _require_finite(self, self.mean, self.std)
        if self.std < 0:
            raise ConfigError(f"{self}: std must not be negative")
        if not self.low <= self.mean <= self.high:
            raise ConfigError(f"{self}: mean must lie between low and high")
        if self._probability_within() < 0.01:
            raise ConfigError(f"{self}: low and high are too close for redraws; use Uniform")

    def _probability_within(self) -> float:
        if self.std == 0:
            return 1.0
        limits = (self.low, self.high)
        low, high = (math.erf((limit - self.mean) / self.std / math.sqrt(2)) for limit in limits)
        return (high - low) / 2

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value; at least every hundredth draw lies within the bounds."""
        while True:
            value = float(rng.normal(self.mean, self.std))
            if self.low <= value <= self.high:
                return value


@dataclass(frozen=True)
class Choice:
    """One of the given numbers, with equal or the given probabilities."""

    values: Sequence[float]
    probabilities: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if not hasattr(self.values, "__len__") or len(self.values) == 0:
            raise ConfigError(f"{self}: expected a list of at least one value")
        weights = self.probabilities
        if weights is None:
            return
        fits = len(weights) == len(self.values) and min(weights) >= 0
        if not (fits and abs(sum(weights) - 1) <= 1e-9):
            raise ConfigError(f"{self}: expected one probability per value, adding up to 1")

    def sample(self, rng: np.random.Generator) -> float:
        """Draw one value."""
        index = rng.choice(len(self.values), p=self.probabilities)
        return self.values[int(index)]


def is_distribution(value: object) -> bool:
    """Whether a value of a config is to be drawn anew at each reset."""
    return not isinstance(value, type) and (hasattr(value, "sample") or hasattr(value, "rvs"))


def draw(value: Any, rng: np.random.Generator) -> Any:
    """Draw from a distribution; anything else is returned as it is.

    Args:
        value: A constant, a ``Distribution`` or a frozen distribution of ``scipy.stats``.
        rng: The generator of the environment.

    Returns:
        The constant, or one number.
    """
    if hasattr(value, "sample"):
        return value.sample(rng)
    if hasattr(value, "rvs"):
        return float(value.rvs(random_state=rng))
    return value


def _require_finite(distribution: object, *numbers: float) -> None:
    if not all(isinstance(number, Real) and math.isfinite(number) for number in numbers):
        raise ConfigError(f"{distribution}: every number must be one, and finite")
