"""The search for a policy: a baseline is tuned, then classes of policies compete with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fmugym.baselines import Controller
from fmugym.baselines.arena import Arena
from fmugym.baselines.cma import CMA
from fmugym.baselines.controller import FloatArray
from fmugym.baselines.entrants import MOST_EPISODES, NO_MERIT, Entrant, Merit, merits_of
from fmugym.baselines.parsing import Search as Tunable
from fmugym.baselines.tuning import Axes
from fmugym.search.agent import Agent
from fmugym.search.policy import Form, Policy, Scale

__all__ = ["FEW", "VALIDATION", "Search"]

VALIDATION: Final = 500_000
"""Episodes of validation have seeds from here on, those of training have smaller ones."""

_FINAL: Final = VALIDATION + 1000
"""The first seed of the last validation, in which all candidates compete."""

FEW: Final = 8
"""The candidates of a round for a controller, which has few numbers."""

_MANY: Final = 32
"""Those of a round for policies."""

_EPISODES: Final = 4
"""Each candidate plays so many, or one if all are the same."""

_VALIDATED: Final = 32
_EVERY: Final = 5
"""Rounds from one validation to the next."""

_LAST: Final = 100
_PART: Final = 5
"""The last validation has so many episodes for each agent, but in all no more than this part of the
episodes of all rounds."""

_TUNING: Final = 30
"""Rounds for the numbers of each controller, and for a constant action."""

_LEAST: Final = 10
_SHARE: Final = 10
"""A class of policies has at least so many rounds, and this part of all rounds."""

_ROUNDS_WITHOUT_GAIN: Final = 15
_STARTS: Final = 3
"""A class that leads and gains nothing in so many rounds starts anew from its best weights. It goes
when that was so in each of these starts."""

_BEST_PART: Final = 4
"""This part of the candidates tells what observations are like, if there is a controller."""

_LARGEST: Final = 30.0
"""The largest root mean square of the weights."""

_GROWTH: Final = 5.0
"""Steps become so many times as large as the first ones, at most."""

_MANY_WEIGHTS: Final = 200
"""More than these are searched without covariances."""

_SIGMA: Final = 1.0
_OF_NETWORKS: Final = 4.0
_OF_CORRECTIONS: Final = 0.4
"""The first steps of the weights, and how many times as large they are in networks, and where they
correct a controller."""

_MIDDLE: Final = Agent("", None)


@dataclass(frozen=True)
class _Tuned:
    """Makes controllers with the numbers of a tunable one."""

    name: str
    tunable: Tunable

    def __call__(self, rows: FloatArray) -> Controller:
        return Policy(self.tunable.make(**Axes(self.tunable.ranges).numbers(rows)))

    def agent(self, best: FloatArray) -> Agent:
        numbers = Axes(self.tunable.ranges).numbers(best)
        return Agent(f"tuned {self.name}", self.tunable.text(numbers))


@dataclass(frozen=True)
class _Policies:
    """Makes policies of one form over one controller."""

    under: Agent
    form: Form
    scale: Scale

    def __call__(self, rows: FloatArray) -> Controller:
        return self.agent(rows).policy()

    def agent(self, best: FloatArray) -> Agent:
        count, name = self.form.features, self.form.name
        parts = self.scale.mean[:count], self.scale.divisor[:count]
        name = name if self.under.text is None else f"{self.under.name} + {name}"
        return Agent(name, self.under.text, self.form, best, parts)


class Search:
    """A search, which goes on round by round. Nothing in it depends on time.

    Args:
        sizes: How many numbers are observed, and how many choose an action.
        fixed: Controllers that are ready.
        tunable: Those with numbers to be found, and their names.
        limits: What each cost may add up to in an episode.
        is_same: Whether all episodes are the same.
        seed: Of the candidates and of the episodes.

    Attributes:
        episodes: How many each candidate plays in the first rounds.
        seed: As given.
        rounds: How many there have been.
        best: The best agent in validation, once there is one.
        merit: Its merit.
        baseline: The best agent without a network, once it is known.
        merit_of_baseline: Its merit.
    """

    def __init__(
        self,
        sizes: tuple[int, int],
        fixed: Sequence[Agent],
        tunable: Sequence[tuple[str, Tunable]],
        limits: Sequence[float] = (),
        is_same: bool = False,
        seed: int = 0,
    ) -> None:
        self._sizes, self._limits, self._fixed = sizes, tuple(limits), list(fixed)
        self.episodes, self.seed = 1 if is_same else _EPISODES, seed
        self._rng = np.random.default_rng(seed)
        self._tuned = [
            Entrant(Axes(one.ranges).search(FEW, self._rng), _Tuned(name, one), self.episodes)
            for name, one in tunable
        ]
        if not (fixed or tunable):
            nothing = Scale(np.empty(0), np.empty(0))
            make = _Policies(_MIDDLE, Form("constant action", 0, sizes[1]), nothing)
            self._tuned = [self._entrant(make, FEW)]
        self._contenders: list[Entrant] = []
        self.best: Agent | None = None
        self.baseline: Agent | None = None
        self.merit = self.merit_of_baseline = NO_MERIT
        self.rounds = 0

    @property
    def is_tuned(self) -> bool:
        """Whether the numbers of all controllers are found, so that policies come next."""
        return all(one.rounds >= _TUNING for one in self._tuned)

    @property
    def is_over(self) -> bool:
        """Whether nothing more is gained."""
        return self.baseline is not None and not self._active

    @property
    def _active(self) -> list[Entrant]:
        """The classes of policies that have not gone."""
        return [one for one in self._contenders if one.starts < _STARTS]

    def others(self) -> list[Agent]:
        """The controllers that were declared, and have numbers now."""
        return [*self._fixed, *(one.make.agent(one.best) for one in self._tuned if one.gained)]

    # Rounds.

    def advance(self, arena: Arena) -> None:
        """Go on by one round, or by the two that tell what observations are like."""
        if not self.is_tuned:
            self._play(min(self._tuned, key=lambda one: one.rounds), arena)
        elif self.baseline is None:
            self.best, self.merit = self._best_of(arena, self.others(), self._validation)
            self.baseline, self.merit_of_baseline = self.best, self.merit
            self._enter(arena, self.baseline)
        else:
            leaders = self._leaders()
            self._play(self._next(leaders), arena)
            self._let_go(leaders)

    def _leaders(self) -> list[Entrant]:
        """The best two; one that is not better than the baseline leads only if none is."""
        ranked = sorted(self._active, key=lambda one: one.merit)
        return ([one for one in ranked if one.merit > self.merit_of_baseline] or ranked)[-2:]

    def _next(self, leaders: Sequence[Entrant]) -> Entrant:
        """Who plays: one that has had less than its share, or else the leaders by turns."""
        share = max(_LEAST, self.rounds // _SHARE)
        behind = [one for one in self._active if one.rounds < share]
        return behind[0] if behind else min(leaders, key=lambda one: one.last_round)

    def _let_go(self, leaders: Sequence[Entrant]) -> None:
        """Give a leader that gains nothing more episodes, and let it go if that is no use."""
        for one in leaders:
            if one.rounds - one.gained < _ROUNDS_WITHOUT_GAIN:
                continue
            if 1 < one.episodes < MOST_EPISODES:
                one.episodes *= 2
            else:
                one.starts += 1
                one.cma = self._cma(one.make, one.best)
            one.gained = one.rounds
            if one.then is not None:
                longer = self._entrant(one.then)
                longer.cma.mean = one.then.form.extended(one.best)
                self._contenders.append(longer)
                one.then = None

    def _play(self, entrant: Entrant, arena: Arena) -> None:
        entrant.play(arena, self._training(entrant.episodes), self._limits)
        self.rounds += 1
        entrant.last_round = self.rounds
        if entrant.rounds % _EVERY == 0:
            entrant.validate(arena, self._validation, self._limits)
            if entrant.merit > self.merit:
                self.best, self.merit = entrant.make.agent(entrant.best), entrant.merit

    def _training(self, count: int) -> list[int]:
        return [int(seed) for seed in self._rng.integers(VALIDATION, size=count)]

    @property
    def _validation(self) -> range:
        return range(VALIDATION, VALIDATION + (_VALIDATED if self.episodes > 1 else 1))

    # Who takes part.

    def _entrant(self, make: _Policies, population: int = _MANY) -> Entrant:
        cma = self._cma(make, np.zeros(make.form.size), population)
        return Entrant(cma, make, self.episodes)

    def _cma(self, make: _Policies, start: FloatArray, population: int = _MANY) -> CMA:
        sigma = _SIGMA * (_OF_NETWORKS if make.form.hidden else 1.0)
        sigma *= 1.0 if make.under.text is None else _OF_CORRECTIONS
        variances = np.ones(len(start)) if len(start) > _MANY_WEIGHTS else None
        limits = {"largest": _LARGEST, "largest_sigma": _GROWTH * sigma}
        return CMA(start, sigma, population, self._rng, variances, **limits)

    def _enter(self, arena: Arena, baseline: Agent) -> None:
        """Find the scale of what is observed, and let classes of policies enter."""
        linear = Form("linear", *self._sizes)
        history = Form("linear with history", *self._sizes, history=True)
        network = Form("network", *self._sizes, hidden=(16,))
        scale = self._scale(arena, history, baseline, _MIDDLE)
        if baseline.text is None:
            alone = [linear, history, network]
        else:  # only these observations are like those that were seen
            alone = [linear, network]
            first = self._entrant(_Policies(baseline, linear, scale))
            first.then = _Policies(baseline, history, scale)
            self._contenders.append(first)
        self._contenders += [self._entrant(_Policies(_MIDDLE, form, scale)) for form in alone]

    def _scale(self, arena: Arena, history: Form, *agents: Agent) -> Scale:
        """What observations are like while candidates add constants to what agents decide.

        If there is a controller, only the best candidates count: policies that are worth something
        see the like, while others may drive the process far away.
        """
        count = history.features
        seen: list[tuple[Merit, FloatArray]] = []
        for agent in agents:
            rows = history.constants(self._rng.uniform(-1, 1, (_MANY, history.acting)))
            make = _Policies(agent, history, Scale(np.zeros(count), np.ones(count)))
            seeds = self._training(self.episodes)
            outcome = arena.play(make, rows, seeds, lambda policy: policy.moments)
            seen += zip(merits_of(outcome, self._limits), outcome.watched.sum(axis=1), strict=True)
            self.rounds += 1
        part = 1 if agents[0].text is None else _BEST_PART
        best = sorted(seen, key=lambda one: one[0])[-(len(seen) // part) :]
        moments = sum((one[1] for one in best), start=np.zeros(()))
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
            agents, searches = list(self._fixed), self._tuned
        else:
            agents = [self.baseline]
            searches = sorted(self._contenders, key=lambda one: one.merit)[-2:]
        agents += [one.make.agent(numbers) for one in searches for numbers in one.offers()]
        most = self.rounds * FEW * self.episodes // (_PART * max(1, len(agents)))
        count = min(_LAST, max(self.episodes, most))
        return agents, range(_FINAL, _FINAL + (count if self.episodes > 1 else 1))

    def winner(self, arena: Arena) -> Agent | None:
        """The best agent in the last validation; None if nobody can compete in it."""
        agents, seeds = self.last_validation()
        if len(agents) < 2:
            return agents[0] if agents else None
        return self._best_of(arena, agents, seeds)[0]
