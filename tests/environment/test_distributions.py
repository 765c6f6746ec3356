"""Distributions: their statistics against scipy, seeds, and what is refused."""

import math

import numpy as np
import pytest
from scipy import stats

from fmugym import Choice, ConfigError, LogUniform, Normal, Uniform
from fmugym.environment.distributions import draw, is_distribution

CASES = [
    (Uniform(-2.0, 3.0), stats.uniform(-2.0, 5.0)),
    (LogUniform(0.01, 100.0), stats.loguniform(0.01, 100.0)),
    (Normal(1.0, 2.0), stats.norm(1.0, 2.0)),
    (Normal(1.0, 2.0, low=0.5, high=4.0), stats.truncnorm(-0.25, 1.5, loc=1.0, scale=2.0)),
]


@pytest.mark.parametrize(("distribution", "reference"), CASES, ids=lambda value: str(value)[:40])
def test_distributed_as_in_scipy(distribution, reference):
    rng = np.random.default_rng(1)
    values = [distribution.sample(rng) for _ in range(2000)]
    assert all(type(value) is float for value in values)
    assert stats.kstest(values, reference.cdf).pvalue > 0.01


@pytest.mark.parametrize("distribution", [case[0] for case in CASES] + [Choice([1, 2, 3])], ids=str)
def test_the_seed_decides(distribution):
    def values(seed):
        rng = np.random.default_rng(seed)
        return [draw(distribution, rng) for _ in range(20)]

    assert values(5) == values(5)
    assert values(5) != values(6)


def test_uniform_is_the_generators_own():
    """So that the draws of Gymnasium's own environments are met bit by bit."""
    value = Uniform(-0.05, 0.05).sample(np.random.default_rng(3))
    assert value == np.random.default_rng(3).uniform(-0.05, 0.05)


class TestChoice:
    def test_equal_probabilities(self):
        rng = np.random.default_rng(0)
        values = [Choice([0.5, 4.0]).sample(rng) for _ in range(1000)]
        assert set(values) == {0.5, 4.0}
        assert stats.binomtest(values.count(0.5), 1000, 0.5).pvalue > 0.01

    def test_given_probabilities(self):
        rng = np.random.default_rng(0)
        values = [Choice([0, 1, 2], [0.7, 0.0, 0.3]).sample(rng) for _ in range(1000)]
        assert 1 not in values
        assert stats.binomtest(values.count(0), 1000, 0.7).pvalue > 0.01


class TestDraw:
    @pytest.mark.parametrize("constant", [1.5, 0, "turbo", None])
    def test_constants_stay(self, constant):
        assert draw(constant, np.random.default_rng(0)) is constant
        assert not is_distribution(constant)

    def test_scipy(self):
        frozen = stats.beta(2, 3)
        assert is_distribution(frozen)
        value = draw(frozen, np.random.default_rng(0))
        assert type(value) is float
        assert value == frozen.rvs(random_state=np.random.default_rng(0))

    def test_a_class_of_the_users_own(self):
        class Coin:
            def sample(self, rng):
                return float(rng.integers(2))

        assert is_distribution(Coin())
        assert not is_distribution(Coin)  # the class was meant to be called
        assert draw(Coin(), np.random.default_rng(0)) in {0.0, 1.0}

    def test_bounds_may_meet(self):
        rng = np.random.default_rng(0)
        assert Uniform(2.0, 2.0).sample(rng) == 2.0
        assert LogUniform(2.0, 2.0).sample(rng) == pytest.approx(2.0, rel=1e-15)
        assert Normal(2.0, 0.0, 2.0, 2.0).sample(rng) == 2.0


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Uniform(1.0, 0.0), "low must not be greater than high"),
        (lambda: Uniform(0.0, math.inf), "finite"),
        (lambda: Uniform(math.nan, 1.0), "finite"),
        (lambda: Uniform("0", 1.0), "low must be a number, got .0."),
        (lambda: LogUniform(0.0, 1.0), "0 < low <= high"),
        (lambda: LogUniform(2.0, 1.0), "0 < low <= high"),
        (lambda: LogUniform(1.0, math.inf), "finite"),
        (lambda: Normal(0.0, -1.0), "std must not be negative"),
        (lambda: Normal(0.0, math.nan), "finite"),
        (lambda: Normal(0.0, 1.0, low=1.0), "mean must lie between"),
        (lambda: Normal(0.0, 1.0, low=math.nan), "mean must lie between"),
        (lambda: Normal(0.0, 1.0, 0.0, 1e-9), "too close for redraws"),
        (lambda: Choice([]), "at least one value"),
        (lambda: Choice(3), "at least one value"),
        (lambda: Choice([1, 2], [1.0]), "one probability per value"),
        (lambda: Choice([1, 2], [0.5, 0.6]), "adding up to 1"),
        (lambda: Choice([1, 2], [1.5, -0.5]), "adding up to 1"),
        (lambda: Choice([1, 2], [math.nan, math.nan]), "adding up to 1"),
    ],
)
def test_refused(make, match):
    with pytest.raises(ConfigError, match=match):
        make()
