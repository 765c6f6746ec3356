"""The search for the numbers of a controller, by many episodes at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.baselines.candidate_evaluation import MOST_STEPS, CandidateEvaluator
from fmugym.baselines.candidate_search import CandidateSearch
from fmugym.baselines.cma import CMA
from fmugym.baselines.controller import Controller
from fmugym.checks import check_count, check_mapping, check_number, check_seed
from fmugym.distributions import LogUniform, Uniform, as_distribution
from fmugym.errors import ConfigError, shown
from fmugym.pool.base import FloatArray

__all__ = ["Tuning", "candidate_search_of", "numbers_at", "tune"]

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
    adaptation of ``fmugym.baselines.cma``, which begins at the best of them. The same arguments
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
