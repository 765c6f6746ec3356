"""The search for a policy: a baseline is tuned, then classes of policies compete with it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any, Final

import numpy as np

from fmugym.control.candidate_evaluation import MOST_STEPS, CandidateEvaluator
from fmugym.control.controller_parsing import has_range, search_of
from fmugym.control.tuning import CMA, NO_MERIT, CandidateSearch, candidate_search_of
from fmugym.training.search.policy import ResidualAgent, scale_of
from fmugym.training.search.probe import FEW, Probe

__all__ = ["VALIDATION", "Search", "tuning_steps"]

VALIDATION: Final = 500_000
"""First seed of validation; episodes of training have smaller ones."""

_FINAL: Final = VALIDATION + 1000
"""The first seed of the last validation, in which all candidates compete."""

_MANY: Final = 32
"""The candidates of a round for policies, and of the first one for the numbers of a controller."""

_EPISODES: Final = 4
"""Each candidate plays so many, or one if all are the same."""

_VALIDATED: Final = 32
_EVERY: Final = 5
"""Rounds from one validation to the next."""

_LAST: Final = 100
_PART: Final = 5
"""The last validation has so many episodes for each agent, but in all no more than this part of the
episodes of all rounds."""

_TRIAL: Final = 5
_TUNING: Final = 20
"""Rounds for each controller, also a constant action, and in all for the best one."""

_A_NUMBER: Final = 6
"""The best one has at least so many for each of its numbers."""

_SHARE: Final = 10
"""A class of policies has at least this part of all rounds."""

_ROUNDS_WITHOUT_GAIN: Final = 15
_STARTS: Final = 3
"""A class that leads and gains nothing in so many rounds starts anew from its best weights. It goes
after so many starts in a row, the first one included, that were in vain."""

_RANDOM: Final = 32
_BEST_PART: Final = 4
"""One of so many candidates with random weights counts for the scale of observations."""

_FINEST: Final = 1e-3
"""Size of the finest weights; the coarsest ones have 1."""

_LARGEST: Final = 30.0
"""The largest root mean square of the weights."""

_GROWTH: Final = 5.0
"""Steps become so many times as large as the first ones, at most."""

_MERIT: Final = attrgetter("merit")

_OF_NETWORKS: Final = 4.0
_OF_CORRECTIONS: Final = 0.4
"""First steps of the weights of networks, and of weights that correct a controller, as multiples of
the usual first step."""


def tuning_steps(most_steps: int | None, is_same: bool) -> int:
    """The steps until the numbers of a controller are found, at most, after the look at the task.

    Args:
        most_steps: Most steps of an episode; None for no limit.
        is_same: Whether all episodes are the same.
    """
    episodes, validated = (1, 1) if is_same else (_EPISODES, _VALIDATED)
    played = (_MANY + (_TUNING - 1) * FEW) * episodes
    steps: int = (played + _TUNING // _EVERY * 2 * validated) * (most_steps or MOST_STEPS)
    return steps


class Search:
    """A search, which goes on round by round. Nothing in it depends on time.

    Args:
        probe: Probe of the task.
        seed: Seed of the candidates and of the episodes.

    Attributes:
        probe, seed: As given.
        episodes: How many each candidate plays in the first rounds.
        rounds: Their number.
        steps: Steps of all environments until the search was last saved.
        controllers: Controllers to be beaten.
        baseline: The best one of them, once it is known.
        policies: The classes of policies, once they have entered.
        rng: Draws all random numbers.
        scale: Mean and scale of observations; see ``scale_of``.
        widths: Number of draws in each of the probes that are still to come.
    """

    def __init__(self, probe: Probe, seed: int) -> None:
        self.probe, self.seed = probe, seed
        self.episodes = 1 if probe.is_same else _EPISODES
        self.rounds, self.steps = 0, probe.steps
        self.rng = np.random.default_rng(seed)
        self.controllers = [
            CandidateSearch(None, one, self.episodes, rounds=_TUNING, best=one)
            if one.is_found
            else self._candidate_search(one)
            for one in probe.agents
        ]
        self.baseline: Any = None
        self.policies: list[CandidateSearch] = []
        self.scale = probe.linear.scale
        self.widths = [probe.linear.size, probe.linear.acting]

    @property
    def random_state(self) -> Mapping[str, Any]:
        """State of the random numbers: integers and texts by name."""
        return dict(self.rng.bit_generator.state)

    @random_state.setter
    def random_state(self, state: Mapping[str, Any]) -> None:
        self.rng.bit_generator.state = state

    @property
    def is_over(self) -> bool:
        """Whether nothing more is gained."""
        return not self.widths and not self._active

    @property
    def tuning(self) -> CandidateSearch | None:
        """Controller to tune next; in the end, the best one alone."""
        new = min(self.controllers, key=attrgetter("rounds"))
        best = max(self.controllers, key=_MERIT)
        found = new if new.rounds < _TRIAL else best
        return found if found.rounds < _most_rounds(found) else None

    @property
    def _active(self) -> list[CandidateSearch]:
        """The classes of policies that have not gone."""
        return [one for one in self.policies if one.starts < _STARTS]

    @property
    def ahead(self) -> CandidateSearch:
        """Search with the best agent in validation."""
        return max(self.controllers + self.policies, key=_MERIT)

    # Rounds.

    def advance(self, evaluator: CandidateEvaluator) -> None:
        """Play one round, or one that measures the observations."""
        if self.tuning:
            self._play(self.tuning, evaluator)
        elif self.widths:
            if self.baseline is None:
                for one in self.controllers:
                    if one.cma is None:
                        one.merit = one.best.play(evaluator, self._seeds(VALIDATION)).merits[0]
                self.baseline = max(self.controllers, key=_MERIT)
            self._look(evaluator, self.baseline.best)
        else:
            leaders = self._leaders()
            self._play(self._next(leaders), evaluator)
            for one in leaders:
                if one.rounds - one.gained >= _ROUNDS_WITHOUT_GAIN:
                    self._change(one)

    def _leaders(self) -> list[CandidateSearch]:
        """The best two; one that is not better than the baseline leads only if none is."""
        ranked = sorted(self._active, key=_MERIT, reverse=True)
        return ([one for one in ranked if one.merit > self.baseline.merit] or ranked)[:2]

    def _next(self, leaders: Sequence[CandidateSearch]) -> CandidateSearch:
        """Choose the next to play: one with less than its share, or the leaders by turns."""
        behind = [one for one in self._active if one.rounds < self.rounds // _SHARE]
        return behind[0] if behind else min(leaders, key=attrgetter("last_round"))

    def _change(self, leader: CandidateSearch) -> None:
        """Give a leader that gains nothing a new start with more episodes; it may be its last."""
        leader.take_more_episodes()
        leader.starts += 1
        leader.cma = self._cma(leader.best)
        leader.gained = leader.rounds
        if leader.then is not None:
            (start,) = leader.then.extended(leader.best.weights[None])
            self.policies.append(self._candidate_search(leader.then.with_numbers(start)))
            leader.then = None

    def _play(self, candidate_search: CandidateSearch, evaluator: CandidateEvaluator) -> None:
        candidate_search.play(
            evaluator, self.rng.integers(VALIDATION, size=candidate_search.episodes).tolist()
        )
        self.rounds += 1
        candidate_search.last_round = self.rounds
        if candidate_search.rounds % _EVERY == 0:
            candidate_search.validate(evaluator, self._seeds(VALIDATION))

    def _seeds(self, first: int, count: int = _VALIDATED) -> range:
        """Seeds of a validation; one is enough if all episodes are the same."""
        return range(first, first + (1 if self.probe.is_same else count))

    def revalidate(self, evaluator: CandidateEvaluator) -> None:
        """Continue in another environment, with the merits that the agents have there."""
        for one in (*self.controllers, *self.policies):
            one.lead, one.starts, one.gained = NO_MERIT, 0, one.rounds
            if one.best:
                one.merit = one.best.play(evaluator, self._seeds(VALIDATION)).merits[0]

    # Candidates.

    def _candidate_search(
        self, agent: ResidualAgent, then: ResidualAgent | None = None
    ) -> CandidateSearch:
        if has_range(agent.text):
            ranges = search_of(agent.text).ranges
            return candidate_search_of(agent, ranges, (_MANY, FEW), self.episodes, self.rng)
        return CandidateSearch(self._cma(agent), agent, self.episodes, then)

    def _cma(self, agent: ResidualAgent) -> CMA:
        """The search for the weights of an agent, which begins with its own ones, or 0."""
        mean = agent.weights if len(agent.weights) else np.zeros(agent.size)
        sigma = _OF_NETWORKS if agent.hidden else _OF_CORRECTIONS if agent.text else 1.0
        population = _MANY if agent.observed else FEW
        return CMA(mean, sigma, population, self.rng, largest=_LARGEST, growth=_GROWTH)

    def _look(self, evaluator: CandidateEvaluator, baseline: ResidualAgent) -> None:
        """Measure observations under the best of some candidates that correct the baseline.

        Policies that are worth something see the like, while others may drive the process far away.
        Some change little: only these keep an unstable process near. In a first look they add
        constants. All of these let a process drift that integrates them, so that linear policies
        tell the scale anew. Then classes of policies enter.
        """
        history = replace(self.probe.linear, name="linear with history", history=True)
        agent = replace(history, text=baseline.text, scale=self.scale)
        sizes = np.geomspace(1.0, _FINEST, _RANDOM)[:, None]
        drawn = self.rng.standard_normal((_RANDOM, self.widths.pop()))
        rows = agent.extended(sizes * drawn)
        seeds = self.rng.integers(VALIDATION, size=self.episodes).tolist()
        outcome = evaluator.play(agent, rows, seeds, has_moments=True)
        self.rounds += 1
        best = outcome.moments[outcome.order[: _RANDOM // _BEST_PART]]
        self.scale = scale_of(best.sum(axis=(0, 1)))
        if not self.widths:
            self._enter(history, baseline)

    def _enter(self, history: ResidualAgent, baseline: ResidualAgent) -> None:
        """Add classes of policies; linear ones are followed by policies that see the past."""
        linear = self.probe.linear
        *linear_ones, network = (
            replace(one, scale=self.scale[:, : one.features])
            for one in (linear, history, replace(linear, name="network", hidden=16))
        )
        for text in dict.fromkeys((baseline.text, None)):
            prefix = f"{baseline.name} + " if text else ""
            pair = (replace(one, name=prefix + one.name, text=text) for one in linear_ones)
            self.policies.append(self._candidate_search(*pair))
        self.policies.append(self._candidate_search(network))

    # The winner.

    def last_validation(self) -> tuple[list[ResidualAgent], range]:
        """Agents that would compete if the search ended now, and the seeds of the episodes.

        These are the baseline and the best two searches, each by its best numbers and by its
        present mean. That may be better, without having shown it in the fewer episodes of earlier
        validations.
        """
        agents, searches = [], self.controllers
        if self.baseline:
            agents.append(self.baseline.best)
            searches = sorted(self.policies, key=_MERIT, reverse=True)[:2]
        for one in searches:
            if one.best:
                agents.append(one.best)
            if one.cma and one.rounds:
                agents.append(one.make.with_numbers(one.cma.mean))
        most = self.rounds * FEW * self.episodes // (_PART * (len(agents) or 1))
        return agents, self._seeds(_FINAL, min(_LAST, max(self.episodes, most)))

    def winner(self, evaluator: CandidateEvaluator) -> ResidualAgent | None:
        """The best agent in the last validation; None if nobody can compete in it."""
        agents, seeds = self.last_validation()
        return max(agents, key=lambda one: one.play(evaluator, seeds).merits[0], default=None)


def _most_rounds(controller: CandidateSearch) -> int:
    """The rounds for the numbers of a controller, if it is the best one."""
    text = controller.make.text
    return max(_TUNING, _A_NUMBER * len(search_of(text).ranges) if has_range(text) else 0)
