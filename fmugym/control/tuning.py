"""Tuning: the search for the numbers of a controller, by many episodes at once.

A search of one class of candidates finds numbers of a controller, or weights of a network. It takes
vectors of numbers from the covariance matrix adaptation, which needs only their order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.checks import check_count, check_mapping, check_number, check_seed
from fmugym.control.candidate_evaluation import MOST_STEPS, CandidateEvaluator, Merit
from fmugym.control.controller import Controller
from fmugym.environment.distributions import LogUniform, Uniform, as_distribution
from fmugym.errors import ConfigError, shown
from fmugym.pool.pool import FloatArray

__all__ = [
    "CMA",
    "MOST_CORRELATED",
    "NO_MERIT",
    "CandidateSearch",
    "Tuning",
    "candidate_search_of",
    "numbers_at",
    "tune",
]

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


NO_MERIT: Final[Merit] = (-math.inf, -math.inf)

_MOST_EPISODES: Final = 64
_AGREEMENT: Final = 0.3
"""If the ranks by two halves of the episodes correlate less, a round has too few of them."""

_FADE: Final = 0.1
"""The part of the way by which one round moves the mean correlation, which chance would reach soon
if few rounds counted."""


@dataclass
class CandidateSearch:
    """A search for the numbers of one class of candidates, and its best results.

    Attributes:
        cma: The search, a ``CMA``; None for a controller whose numbers are known.
        make: Makes a controller for N environments from their numbers, shape (N, n). For
            validation, it has the method ``with_numbers`` of an ``Agent``.
        episodes: How many each candidate plays in a round.
        then: Class of candidates that enters when this one gains nothing; None for nothing.
        first: The candidates of the first round, shape (n, k); ``cma`` goes on from the best of
            them. None if ``cma`` draws them.
        rounds: Number of its rounds.
        leader: The numbers of the best candidate since the last validation, shape (n,).
        lead: Its merit.
        best: The agent with the best numbers in validation; None before the first one.
        merit: Its merit.
        gained: The round in which it was found, or in which something was changed.
        starts: How often in a row it has gained nothing in a start.
        agreement: The mean correlation of ranks by two halves of the episodes.
        last_round: The round of the whole search in which it played last.
    """

    cma: Any
    make: Any
    episodes: int
    then: Any = None
    first: Any = None
    rounds: int = 0
    leader: Any = None
    lead: Merit = NO_MERIT
    best: Any = None
    merit: Merit = NO_MERIT
    gained: int = 0
    starts: int = 0
    agreement: float = 1.0
    last_round: int = 0

    def play(self, evaluator: CandidateEvaluator, seeds: Sequence[int]) -> Merit:
        """Do a round, and return the merit of its best candidate.

        Ranks decide, so that the scale of rewards does not matter.
        """
        first, self.first = self.first, None
        found = self.cma.ask() if first is None else first
        outcome = evaluator.play(self.make, found, seeds)
        best = outcome.order[0]
        if first is None:
            self.cma.tell(np.array(outcome.order))
        else:
            self.cma.mean = found[best]
        self.rounds += 1
        reached = outcome.merits[best]
        if not reached <= self.lead:  # NaN included
            self.leader, self.lead = found[best], reached
        self._note_agreement(outcome.returns)
        return reached

    def _note_agreement(self, returns: FloatArray) -> None:
        """Double the number of episodes if chance decides on the order of candidates.

        That is so if the ranks by two halves of the episodes hardly correlate, in the mean of some
        rounds.
        """
        if len(returns.T) == 1:
            return
        halves = (part.mean(axis=1) for part in np.array_split(returns, 2, axis=1))
        ranks = [np.unique(half, return_inverse=True)[1] for half in halves]
        if np.ptp(ranks, axis=1).all():  # otherwise all have reached the same
            correlation = np.min(np.corrcoef(ranks))
            self.agreement += _FADE * (float(correlation) - self.agreement)
        if self.agreement < _AGREEMENT:
            self.take_more_episodes()
            self.agreement = 1.0

    def take_more_episodes(self) -> None:
        """Double the number of episodes, up to ``_MOST_EPISODES``; one stays one.

        A single episode is enough where all are the same.
        """
        if 1 < self.episodes < _MOST_EPISODES:
            self.episodes *= 2

    def validate(self, evaluator: CandidateEvaluator, seeds: Sequence[int]) -> None:
        """Let the mean of the search and the leader play; the better one is kept if it is the best.

        The search goes on from the leader if that is better: where most candidates reach the same,
        their mean does not come near the few that reach more.
        """
        merits = evaluator.play(self.make, np.stack([self.cma.mean, self.leader]), seeds).merits
        if merits[1] > merits[0]:
            self.cma.mean = self.leader
        if not max(merits) <= self.merit:
            self.merit, self.gained, self.starts = max(merits), self.rounds, 0
            self.best = self.make.with_numbers(self.cma.mean)
        self.lead = NO_MERIT


_LEAST_CANDIDATES: Final = 8
_SIGMA: Final = 0.2
"""Of candidates after the first round, as a part of the ranges, at most."""


@dataclass(frozen=True)
class Tuning:
    """Result of a search for the numbers of a controller.

    Attributes:
        controller: The best controller, to be bound.
        parameters: Its numbers by name.
        mean_return: The mean of the total rewards of its episodes.
        returns: The mean return of the best candidate of each round.
    """

    controller: Controller
    parameters: Mapping[str, float]
    mean_return: float
    returns: tuple[float, ...]


def candidate_search_of(
    make: Any,
    ranges: Mapping[str, Uniform | LogUniform],
    sizes: tuple[int, int],
    episodes: int,
    rng: np.random.Generator,
) -> CandidateSearch:
    """A search for numbers, which begins everywhere and goes on from the best candidate.

    Args:
        make: As for a ``CandidateSearch``.
        ranges: Ranges of the numbers, as ``numbers_at`` takes them.
        sizes: The candidates of the first round, and of the others.
        episodes: How many each candidate plays.
        rng: Draws them.
    """
    first, others = sizes
    places = rng.uniform(size=(first, len(ranges)))
    cma = CMA(places[0], _SIGMA, others, rng, growth=1.0)
    return CandidateSearch(cma, make, episodes, first=places)


def numbers_at(
    ranges: Mapping[str, Uniform | LogUniform], places: FloatArray
) -> dict[str, FloatArray]:
    """The numbers at places of shape (n, k), each of shape (n,).

    Args:
        ranges: The range of each of the k numbers by name; it goes from place 0 to place 1.
        places: For one place, of shape (k,), each is a number. Those beyond 0 and 1 are folded
            back.
    """
    folded = 1.0 - np.abs(1.0 - np.mod(places, 2.0))
    pairs = zip(ranges.items(), folded.T, strict=True)
    return {name: _value(given, column) for (name, given), column in pairs}


def _value(given: Uniform | LogUniform, places: FloatArray) -> FloatArray:
    low, high = given.low, given.high
    is_log = isinstance(given, LogUniform)
    values = low * (high / low) ** places if is_log else low + places * (high - low)
    return np.clip(values, low, high)


def tune(
    make_controller: Callable[..., Controller],
    make_env: Callable[[], Any],
    search: Mapping[str, Any],
    *,
    candidates: int = 32,
    episodes: int = 8,
    rounds: int = 20,
    most_steps: int = MOST_STEPS,
    seed: int = 0,
    watch: Callable[[Tuning], None] | None = None,
    advance: Callable[[float], None] = lambda rounds: None,
) -> Tuning:
    """Find the numbers with which a controller gets the largest rewards.

    In each round, all candidates play the same episodes side by side in one vector environment. The
    first candidates are everywhere in the ranges. The next ones come from the covariance matrix
    adaptation of ``fmugym.control.tuning``, which begins at the best of them. The same arguments
    give the same result.

    Args:
        make_controller: Makes a controller from the numbers by keyword, such as
            ``functools.partial(PID, "T", 21.0)``. It gets an array for each number, with one value
            for each environment, as ``PID`` and ``Hysteresis`` take it.
        make_env: A function that makes the environment, or its class.
        search: For each number a ``Uniform`` or a ``LogUniform`` over the values to be tried.
        candidates: The sets of numbers that are tried in each round, at least 8.
        episodes: How many episodes each of them plays. Those of all rounds are the same.
        rounds: The number of rounds.
        most_steps: Steps after which an episode is stopped.
        seed: Seed of the candidates and of the episodes.
        watch: Gets the best candidate until now after each round.
        advance: Is told of each step, as a part of a round.

    Returns:
        The best of all candidates, and how the search went.

    Raises:
        ConfigError: If an argument does not fit.
    """
    for what, value in (("episodes", episodes), ("rounds", rounds), ("most_steps", most_steps)):
        check_count(what, value)
    check_number("candidates", check_count("candidates", candidates), _LEAST_CANDIDATES)
    given = check_mapping("search", search)
    ranges = {name: _range(name, one) for name, one in given.items()}
    if not ranges:
        raise ConfigError("search needs the name of at least one number")
    seed = check_seed(seed) or 0
    candidate_search = candidate_search_of(
        lambda rows: make_controller(**numbers_at(ranges, rows)),
        ranges,
        (candidates, candidates),
        episodes,
        np.random.default_rng(seed),
    )
    returns: list[float] = []
    with closing(CandidateEvaluator(make_env, most_steps=most_steps, advance=advance)) as evaluator:
        for _ in range(rounds):
            _, reached = candidate_search.play(evaluator, range(seed, seed + episodes))
            returns.append(reached)
            best = {
                name: float(one)
                for name, one in numbers_at(ranges, candidate_search.leader).items()
            }
            found = Tuning(make_controller(**best), best, max(returns), tuple(returns))
            if watch is not None:
                watch(found)
    return found


def _range(name: str, given: Any) -> Uniform | LogUniform:
    distribution = as_distribution(f"search[{name!r}]", given)
    if not isinstance(distribution, Uniform | LogUniform):
        raise ConfigError(f"search[{name!r}] must be Uniform or LogUniform, got {shown(given)}")
    return distribution
