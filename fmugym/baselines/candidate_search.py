"""Search of one class of candidates: numbers of a controller, or weights of a network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.baselines.candidate_evaluation import CandidateEvaluator, Merit
from fmugym.pool.base import FloatArray

__all__ = ["NO_MERIT", "CandidateSearch"]

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
        """Take twice as many episodes, unless all are the same or they are enough."""
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
