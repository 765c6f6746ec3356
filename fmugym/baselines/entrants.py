"""Who takes part in a search: controllers with numbers to be found, and classes of policies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from fmugym.baselines.arena import Arena, Outcome
from fmugym.baselines.cma import CMA
from fmugym.baselines.controller import FloatArray

__all__ = ["MOST_EPISODES", "NO_MERIT", "Entrant", "Merit", "merits_of"]

Merit = tuple[float, float]
"""How good a candidate is: minus the excess of its costs, and its mean return. More is better."""

NO_MERIT: Final[Merit] = (-math.inf, -math.inf)

MOST_EPISODES: Final = 64
_AGREEMENT: Final = 0.3
"""If the ranks by two halves of the episodes correlate less, a round has too few of them."""

_FADE: Final = 0.1
"""The part of the way by which one round moves the mean correlation, which chance would reach soon
if few rounds counted."""


def merits_of(outcome: Outcome, limits: Sequence[float]) -> list[Merit]:
    """The merit of each candidate: those within the limits of all costs come first.

    Args:
        outcome: What they have reached.
        limits: What each cost may add up to in an episode.
    """
    means: FloatArray = outcome.costs.mean(axis=1)
    bounds = np.array(limits, np.float64)
    sizes = np.where(bounds == 0.0, 1.0, np.abs(bounds))
    excess = (np.maximum(means - bounds, 0.0) / sizes).sum(axis=1)
    returns = outcome.returns.mean(axis=1)
    return list(zip((-excess).tolist(), returns.tolist(), strict=True))


@dataclass
class Entrant:
    """One search, and what has come of it.

    Attributes:
        cma: The search.
        make: Makes a controller for N environments from their numbers, shape (N, n).
        episodes: How many each candidate plays in a round.
        rounds: How many it has had.
        leader: The numbers of the best candidate since the last validation, shape (n,).
        lead: Its merit.
        merit: That of the best numbers in validation.
        best: Its numbers, shape (n,).
        gained: The round in which it was found, or in which something was changed.
        starts: How often the search has started anew.
        then: Makes larger controllers, which enter when these gain nothing; None for none.
        agreement: The mean correlation of ranks by two halves of the episodes.
        last_round: The round of the whole search in which it played last.
    """

    cma: CMA
    make: Any
    episodes: int
    rounds: int = 0
    leader: FloatArray = field(default_factory=lambda: np.empty(0))
    lead: Merit = NO_MERIT
    merit: Merit = NO_MERIT
    best: FloatArray = field(default_factory=lambda: np.empty(0))
    gained: int = 0
    starts: int = 0
    then: Any = None
    agreement: float = 1.0
    last_round: int = 0

    def play(self, arena: Arena, seeds: Sequence[int], limits: Sequence[float]) -> Merit:
        """Do a round, and return the merit of its best candidate.

        Ranks decide, so that the scale of rewards does not matter.
        """
        found = self.cma.ask()
        outcome = arena.play(self.make, found, seeds)
        merits = merits_of(outcome, limits)
        order = sorted(range(len(found)), key=merits.__getitem__, reverse=True)
        self.cma.tell(np.array(order))
        self.rounds += 1
        if merits[order[0]] > self.lead:
            self.leader, self.lead = found[order[0]], merits[order[0]]
        self._note_agreement(outcome.returns)
        return merits[order[0]]

    def _note_agreement(self, returns: FloatArray) -> None:
        """Take twice as many episodes where chance decides on the order of candidates.

        That is so if the ranks by two halves of the episodes hardly correlate, in the mean of some
        rounds.
        """
        if not 1 < returns.shape[1] < MOST_EPISODES:
            return
        first, second = (_ranks(part.mean(axis=1)) for part in np.array_split(returns, 2, axis=1))
        size = math.sqrt((first @ first) * (second @ second))
        if size > 0:  # otherwise all have reached the same
            self.agreement += _FADE * (float(first @ second) / size - self.agreement)
        if self.agreement < _AGREEMENT:
            self.episodes, self.agreement = 2 * self.episodes, 1.0

    def validate(self, arena: Arena, seeds: Sequence[int], limits: Sequence[float]) -> None:
        """Let the mean of the search and the leader play; the better one is kept if it is the best.

        The search goes on from the leader if that is better: where most candidates reach the same,
        their mean does not come near the few that reach more.
        """
        numbers = np.stack([self.cma.mean, self.leader])
        merits = merits_of(arena.play(self.make, numbers, seeds), limits)
        if merits[1] > merits[0]:
            self.cma.mean = self.leader
        if max(merits) > self.merit:
            self.merit, self.best, self.gained = max(merits), self.cma.mean.copy(), self.rounds
        self.lead = NO_MERIT

    def offers(self) -> list[FloatArray]:
        """The best numbers and the present mean, as far as they are there."""
        found = (self.best, self.gained), (self.cma.mean, self.rounds)
        return [numbers for numbers, rounds in found if rounds]


def _ranks(values: FloatArray) -> FloatArray:
    """Ranks beside their mean, equal ones for equal values."""
    _, inverse = np.unique(values, return_inverse=True)
    ranks: FloatArray = inverse - inverse.mean()
    return ranks
