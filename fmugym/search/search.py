"""The search for a policy: a baseline is tuned, then classes of policies compete with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from fmugym.baselines import Controller
from fmugym.baselines.arena import Arena
from fmugym.baselines.base import FloatArray
from fmugym.baselines.cma import CMA
from fmugym.baselines.entrants import MOST_EPISODES, NO_MERIT, Entrant, Merit, merits_of
from fmugym.baselines.parsing import Search as Tunable
from fmugym.baselines.tuning import Axes
from fmugym.search.agent import Agent
from fmugym.search.policy import Form, Policy, Scale

__all__ = ["EPISODES", "POPULATION", "VALIDATION", "Search"]

VALIDATION: Final = 500_000
"""Episodes of validation have seeds from here on, those of training have smaller ones."""

_FINAL: Final = VALIDATION + 1000
"""The first seed of the last validation, in which all candidates compete."""

POPULATION: Final = 32
EPISODES: Final = 4
_VALIDATED: Final = 32
_EVERY: Final = 5
"""Rounds from one validation to the next."""

_LAST: Final = 100
_PART: Final = 5
"""The last validation has so many episodes for each agent, but in all no more than this part of the
episodes of all rounds."""

_TUNING: Final = 15
"""Rounds for the numbers of a controller."""

_TRYING: Final = 5
"""Rounds for each guess, of which the best then has the others, and for a constant action."""

_LEAST: Final = 10
_SHARE: Final = 10
"""A class of policies has at least so many rounds, and this part of all rounds."""

_PATIENCE: Final = 15
_STARTS: Final = 3
"""A class that leads and gains nothing in so many rounds starts anew from its best weights. It goes
when that was so in each of these starts."""

_LARGEST: Final = 30.0
"""The largest root mean square of the weights."""

_GROWTH: Final = 5.0
"""Steps become so many times as large as the first ones, at most."""

_MANY: Final = 200
"""More weights than this are searched without covariances."""

_SIGMA: Final = 1.0
_SIGMA_OF_NETWORKS: Final = 4.0
_CORRECTION: Final = 0.4
"""The first steps of the weights, and the part of them where they correct a controller."""


@dataclass(frozen=True)
class _Tuned:
    """Makes controllers with the numbers of a tunable one."""

    name: str
    tunable: Tunable

    def __call__(self, rows: FloatArray) -> Controller:
        return Policy(self.tunable.make(**Axes(self.tunable.ranges).numbers(rows)))

    def agent(self, best: FloatArray) -> Agent:
        numbers = Axes(self.tunable.ranges).numbers(best[None])
        found = {name: float(values[0]) for name, values in numbers.items()}
        return Agent(f"tuned {self.name}", self.tunable.text(found))


@dataclass(frozen=True)
class _Policies:
    """Makes policies of one form over one controller."""

    under: Agent
    form: Form
    scale: Any
    correlations: FloatArray | None = None

    def __call__(self, rows: FloatArray) -> Controller:
        return self.agent(rows).policy()

    def agent(self, best: FloatArray) -> Agent:
        name = (
            self.form.name if self.under.text is None else f"{self.under.name} + {self.form.name}"
        )
        return Agent(name, self.under.text, self.form, best, self.scale)


class Search:
    """A search, which goes on round by round. Nothing in it depends on time.

    Args:
        sizes: How many numbers are observed, and how many choose an action.
        fixed: Controllers that are ready.
        tunable: Those with numbers to be found, by name.
        guesses: Such controllers that nobody has declared: only the best of them is tuned.
        limits: What each cost may add up to in an episode.
        population: The candidates of a round.
        episodes: How many each plays; 1 if all episodes are the same.
        seed: Of the candidates and of the episodes.

    Attributes:
        population, episodes, seed: As given.
        rounds: How many there have been.
        is_over: Whether nothing more is gained.
        baseline: The best agent without a network, once it is known.
        merit_of_baseline: Its merit in validation.
    """

    def __init__(
        self,
        sizes: tuple[int, int],
        fixed: Sequence[Agent],
        tunable: Mapping[str, Tunable],
        guesses: Sequence[Tunable],
        limits: Sequence[float] = (),
        population: int = POPULATION,
        episodes: int = EPISODES,
        seed: int = 0,
    ) -> None:
        self._sizes, self._limits, self._fixed = sizes, tuple(limits), list(fixed)
        self.population, self.episodes, self.seed = population, episodes, seed
        self._rng = np.random.default_rng(seed)
        self._tuned = [self._tuner(name, one) for name, one in tunable.items()]
        self._guesses = [self._tuner("PI", one, _TRYING) for one in guesses]
        if not (fixed or tunable or guesses):
            form = Form("constant action", *sizes, blind=True)
            make = _Policies(Agent("", None), form, (np.empty(0), np.empty(0)))
            self._tuned = [replace(self._entrant(make), quota=_TRYING)]
        self._contenders: list[Entrant] = []
        self._gone: list[Entrant] = []
        self.baseline: Agent | None = None
        self.merit_of_baseline = NO_MERIT
        self.rounds, self.is_over, self._played = 0, False, 0

    @property
    def is_tuned(self) -> bool:
        """Whether the numbers of all controllers are found, so that policies come next."""
        return not self._guesses and all(one.rounds >= one.quota for one in self._tuned)

    def known(self) -> list[tuple[Agent, Merit]]:
        """The agents that were found until now, and their merits in validation."""
        if self.baseline is not None:
            first, entrants = (
                [(self.baseline, self.merit_of_baseline)],
                self._contenders + self._gone,
            )
        else:
            first, entrants = [], self._tuned + self._guesses
        return [*first, *((one.make.agent(one.best), one.merit) for one in entrants if one.gained)]

    def others(self) -> list[Agent]:
        """The controllers that were declared, and have numbers now."""
        return [*self._fixed, *(one.make.agent(one.best) for one in self._tuned if one.gained)]

    # Rounds.

    def advance(self, arena: Arena) -> None:
        """Go on by one round, or by the two that tell what observations are like."""
        waiting = self._waiting()
        if waiting is not None:
            self._play(waiting, arena)
        elif self.baseline is None:
            self.baseline, self.merit_of_baseline = self._best_of(
                arena, self.others(), self._validation
            )
            self._enter(arena, self.baseline)
        else:
            leaders = self._leaders()
            self._play(self._next(leaders), arena)
            self._let_go(leaders)

    def _waiting(self) -> Entrant | None:
        """The controller that is to be tuned next."""
        for one in [*self._tuned, *self._guesses]:
            if one.rounds < one.quota:
                return one
        if self._guesses:
            self._tuned.append(max(self._guesses, key=lambda one: one.merit))
            self._tuned[-1].quota, self._guesses = _TUNING, []
            return self._waiting()
        return None

    def _leaders(self) -> list[Entrant]:
        """The best two; one that is not better than the baseline leads only if none is."""
        ranked = sorted(self._contenders, key=lambda one: one.merit)
        return ([one for one in ranked if one.merit > self.merit_of_baseline] or ranked)[-2:]

    def _next(self, leaders: Sequence[Entrant]) -> Entrant:
        """Who plays: one that has had less than its share, or else the leaders by turns."""
        share = max(_LEAST, self.rounds // _SHARE)
        behind = [one for one in self._contenders if one.rounds < share]
        return behind[0] if behind else min(leaders, key=lambda one: one.rounds)

    def _let_go(self, leaders: Sequence[Entrant]) -> None:
        """Give a leader that gains nothing more episodes, and let it go if that is no use."""
        for one in leaders:
            if one.rounds - one.gained < _PATIENCE:
                continue
            if 1 < one.episodes < MOST_EPISODES:
                one.episodes *= 2
            else:
                one.starts += 1
                one.cma = self._cma(one.make, one.best)
            one.gained = one.rounds
            if one.then is not None:
                start = one.then.form.extended(one.best)
                self._contenders.append(
                    Entrant(self._cma(one.then, start), one.then, self.episodes)
                )
                one.then = None
            if one.starts == _STARTS:
                self._contenders.remove(one)
                self._gone.append(one)
        self.is_over = not self._contenders

    def _play(self, entrant: Entrant, arena: Arena) -> None:
        self._played += self.population * entrant.episodes
        entrant.play(arena, self._training(entrant.episodes), self._limits)
        self.rounds += 1
        if entrant.rounds % _EVERY == 0:
            entrant.validate(arena, self._validation, self._limits)

    def _training(self, count: int) -> list[int]:
        return [int(seed) for seed in self._rng.integers(VALIDATION, size=count)]

    @property
    def _validation(self) -> range:
        return range(VALIDATION, VALIDATION + (_VALIDATED if self.episodes > 1 else 1))

    # Who takes part.

    def _tuner(self, name: str, tunable: Tunable, quota: int = _TUNING) -> Entrant:
        cma = Axes(tunable.ranges).search(self.population, self._rng)
        return Entrant(cma, _Tuned(name, tunable), self.episodes, quota)

    def _entrant(self, make: _Policies) -> Entrant:
        cma = self._cma(make, np.zeros(make.form.size))
        return Entrant(cma, make, self.episodes)

    def _cma(self, make: _Policies, start: FloatArray) -> CMA:
        sigma = _SIGMA_OF_NETWORKS if make.form.hidden else _SIGMA
        sigma *= 1.0 if make.under.text is None else _CORRECTION
        alike = np.ones(len(start))
        if len(start) <= _MANY:
            alike = make.form.covariance(make.correlations)
        limits = {"largest": _LARGEST, "largest_sigma": _GROWTH * sigma}
        return CMA(start, sigma, self.population, self._rng, alike, **limits)

    def _enter(self, arena: Arena, baseline: Agent) -> None:
        """Find the scale of what is observed, and let classes of policies enter."""
        linear = Form("linear", *self._sizes)
        history = Form("linear with history", *self._sizes, history=True)
        network = Form("network", *self._sizes, hidden=(16,))
        middle = Agent("", None)
        scale = self._scale(arena, history, baseline, middle)

        def make(under: Agent, form: Form, correlations: FloatArray | None = None) -> _Policies:
            parts = scale.mean[: form.features], scale.divisor[: form.features]
            return _Policies(under, form, parts, correlations)

        if baseline.text is None:
            alone = [linear, history, network]
        else:  # only these observations are like those that were seen
            alone = [linear, network]
            first = self._entrant(make(baseline, linear, scale.correlations))
            first.then = make(baseline, history, scale.correlations)
            self._contenders.append(first)
        self._contenders += [self._entrant(make(middle, form)) for form in alone]

    def _scale(self, arena: Arena, history: Form, *agents: Agent) -> Scale:
        """What observations are like while each candidate adds another constant."""
        count, acting = history.features, history.acting
        moments: FloatArray = np.zeros(())
        for agent in agents:
            rows = np.zeros((self.population, history.size))
            rows[:, -acting:] = self._rng.uniform(-1, 1, (self.population, acting))
            rows *= np.sqrt(history.shapes[0][0])
            make = _Policies(agent, history, (np.zeros(count), np.ones(count)))
            seeds = self._training(self.episodes)
            outcome = arena.play(make, rows, seeds, lambda policy: policy.moments)
            moments = moments + outcome.watched.sum(axis=(0, 1))
            self.rounds += 1
        return Scale.of(moments, count)

    # Who wins.

    def _best_of(
        self, arena: Arena, agents: Sequence[Agent], seeds: Sequence[int]
    ) -> tuple[Agent, Merit]:
        """The best agent, the first one of equals."""
        merits = [merits_of(one.play(arena, seeds), self._limits)[0] for one in agents]
        best = max(range(len(agents)), key=merits.__getitem__)
        return agents[best], merits[best]

    def last_validation(self) -> tuple[list[Agent], range]:
        """Who would compete if the search ended now, and the seeds of the episodes.

        These are the baseline and the best two searches, each by its best numbers and by its
        present mean. That may be better, without having shown it in the fewer episodes of earlier
        validations.
        """
        if self.baseline is None:
            agents, searches = list(self._fixed), [*self._tuned, *self._guesses]
        else:
            agents, searches = [self.baseline], [*self._contenders, *self._gone]
            searches = sorted(searches, key=lambda one: one.merit)[-2:]
        agents += [one.make.agent(numbers) for one in searches for numbers in one.offers()]
        count = min(_LAST, max(self.episodes, self._played // (_PART * max(1, len(agents)))))
        return agents, range(_FINAL, _FINAL + (count if self.episodes > 1 else 1))

    def winner(self, arena: Arena) -> Agent | None:
        """The best agent in the last validation; None if nobody can compete in it."""
        agents, seeds = self.last_validation()
        if len(agents) < 2:
            return agents[0] if agents else None
        return self._best_of(arena, agents, seeds)[0]
