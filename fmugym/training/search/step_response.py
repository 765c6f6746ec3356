"""Step responses of a task: the final change of each observation by each action.

The relative gain array of such changes pairs actions with measured values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations
from typing import Final

import numpy as np
import numpy.typing as npt

from fmugym.control.candidate_evaluation import CandidateEvaluator
from fmugym.control.controller import Controller
from fmugym.pool.pool import FloatArray

__all__ = [
    "FEWEST",
    "MOST_PAIRED",
    "StepResponses",
    "best_pairing",
    "episodes_of",
    "niederlinski_index",
    "relative_gains",
    "step_test",
]

MOST_PAIRED: Final = 8
"""Actions that are paired, at most, as all orders are tried."""

_LEAST: Final = 1e-6
"""A relative gain below this is none: such a pair has no effect once the other loops are closed."""


def relative_gains(gains: FloatArray) -> FloatArray:
    """The relative gain array of Bristol (1966): each gain, beside that with all others controlled.

    Args:
        gains: Gains of each measured value by each action, shape (n, n).
    """
    relative: FloatArray = gains * np.linalg.pinv(gains).T
    return relative


def niederlinski_index(gains: FloatArray, pairing: Sequence[int]) -> float:
    """The index of Niederlinski (1971); loops with integrals are unstable if it is negative.

    Args:
        gains: As for ``relative_gains``.
        pairing: The row of each column.
    """
    paired = gains[list(pairing)]
    return float(np.linalg.det(paired) / np.prod(np.diag(paired)))


def best_pairing(gains: FloatArray) -> tuple[tuple[int, ...], float] | None:
    """The row of each column whose loops disturb each other least.

    Relative gains of pairs are positive, and so is the index of Niederlinski. Of such pairings, the
    relative gain array of the best one is nearest to that of loops that do not touch each other, by
    the sum of all differences (the RGA number of Skogestad and Postlethwaite, 2005).

    Returns:
        The pairing and its RGA number; None if there is no such pairing.
    """
    relative = relative_gains(gains)
    size = len(gains)
    allowed = (
        pairing
        for pairing in permutations(range(size))
        if (relative[pairing, range(size)] > _LEAST).all()
        and niederlinski_index(gains, pairing) > 0
    )
    numbers = {one: float(np.abs(relative[list(one)] - np.eye(size)).sum()) for one in allowed}
    best = min(numbers, key=numbers.__getitem__, default=None)
    return None if best is None else (best, numbers[best])


_BoolArray = npt.NDArray[np.bool_]

_POINTS: Final = (0.25, 0.5, 0.75)
"""Operating points: all actions are at this part of their ranges."""

_STEP: Final = 0.125
"""By this part of its range, an action is stepped up and down."""

_SEED: Final = 0
_QUARTERS: Final = 4
FEWEST: Final = 2 * _QUARTERS
"""A response of so many steps tells nothing."""

_NOTHING: Final = 1e-6
"""A response below this part of the observed magnitude counts as none."""

_AGREEMENT: Final = 0.5
"""The least ratio of the mean of all responses to that of their magnitudes; below it, the sign
depends on the operating point."""

_GROWING: Final = 0.2
_EVENLY: Final = 0.9
"""A response does not settle if the last quarter adds more than a fifth of it, and no less than
nine tenths of what the quarter before has added. Otherwise it is only slow."""

_EXPLODING: Final = 1.7
"""A response runs away if each quarter adds more than the one before by this factor. Those in
proportion to the square of time add twice and 1.5 times as much."""

_FALLING: Final = 1.2
"""As ``_EXPLODING``, where most episodes end early: what falls has no time to do more."""

_AT_ONCE: Final = 0.9


@dataclass(frozen=True)
class StepResponses:
    """Responses of k observations to steps of n actions.

    Attributes:
        names: Names of the observations.
        responses: Differences to the unstepped twins, beside the step as a part of the action's
            range: of each of the steps of each action in the first step of an episode, and the
            means of the quarters of an episode; NaN if it is too short. Shape (s, n, 5, k).
        ends: The mean observation of the last quarter of each episode, shape (m, k).
        end_early: Whether most episodes end before their time.
    """

    names: tuple[str, ...]
    responses: FloatArray
    ends: FloatArray
    end_early: bool

    @cached_property
    def _means(self) -> FloatArray:
        """Means of all steps, shape (5, k, n)."""
        known = np.isfinite(self.responses[..., :1, :1])
        count = np.maximum(known.sum(axis=0), 1)
        means: FloatArray = (np.where(known, self.responses, 0.0).sum(axis=0) / count).T
        return means.swapaxes(0, 1)

    @property
    def _is_sure(self) -> _BoolArray:
        """Whether there is a response whose sign does not depend on the operating point."""
        last = np.nan_to_num(self.responses[:, :, -1])
        known = np.maximum(np.isfinite(self.responses[:, :, -1]).sum(axis=0), 1)
        magnitude = (np.abs(last).sum(axis=0) / known).T
        sizes = np.abs(self.ends).max(axis=0)[:, None]
        agrees = np.abs(self._means[-1]) >= _AGREEMENT * magnitude
        sure: _BoolArray = agrees & (magnitude > _NOTHING * sizes)
        return sure

    @property
    def gains(self) -> FloatArray:
        """The final changes by the range of an action, shape (k, n).

        They are what the last quarter adds, for observations that do not settle, and 0 where no
        sign is sure.
        """
        last, added = self._means[-1], np.diff(self._means[1:], axis=0)
        grown = added * np.sign(last)
        grows = (grown[-1] > _GROWING * np.abs(last)) & (grown[-1] > _EVENLY * grown[-2])
        most = np.abs(last).argmax(axis=1)[:, None]
        final = np.where(np.take_along_axis(grows, most, axis=1), added[-1], last)
        return np.where(self._is_sure, final, 0.0)

    @property
    def final(self) -> FloatArray:
        """The mean changes in the last quarter of an episode by the range of an action."""
        last: FloatArray = self._means[-1]
        return last

    @property
    def runs_away(self) -> list[str]:
        """The observations that an action lets grow exponentially."""
        first, second, third = np.diff(self._means[1:], axis=0) * np.sign(self.final)
        factor = _FALLING if self.end_early else _EXPLODING
        grows = (first > 0) & (second > factor * first) & (third > factor * second)
        away = (grows & self._is_sure).any(axis=1)
        return [name for name, one in zip(self.names, away, strict=True) if one]

    @property
    def is_instant(self) -> _BoolArray:
        """Whether each observation follows an action at once and never after, shape (k,)."""
        first, last = np.abs(self._means[[0, -1]])
        instant: _BoolArray = ((first >= _AT_ONCE * last) | ~self._is_sure).all(axis=1)
        return instant


class _Held(Controller):
    """Holds an action in each environment, and records observations."""

    def __init__(self, actions: FloatArray) -> None:
        self.actions = actions
        self.rows: list[FloatArray] = []

    def _decide(self, rows: FloatArray) -> FloatArray:
        self.rows.append(rows.copy())
        return self.actions

    @property
    def moments(self) -> FloatArray:
        """One in each step, so that their sum is the length of an episode."""
        return np.ones((1, self.count))

    def course(self, length: int) -> FloatArray:
        """Observations of so many steps, shape (length, N, k); the last one is repeated."""
        return np.stack([*self.rows, *self.rows[-1:] * (length - len(self.rows))])


def episodes_of(actions: int) -> int:
    """Number of episodes of a test of so many actions."""
    return len(_POINTS) * (1 + 2 * actions)


def step_test(
    evaluator: CandidateEvaluator, limits: Sequence[tuple[float, float]]
) -> StepResponses:
    """Step each action up and down at three operating points, beside an unstepped twin.

    All episodes have the same seed, so that noise and disturbances cancel in the differences. The
    actions are held from the beginning on.

    Args:
        evaluator: Plays the episodes. They may be as long as ``evaluator.most_steps``.
        limits: Limits of each action.
    """
    count, (low, high) = len(limits), np.array(limits).T
    unit = np.eye(count)
    steps = np.concatenate([np.zeros((1, count)), unit, -unit])
    parts = np.concatenate([point + _STEP * steps for point in _POINTS])
    names, courses = _played(evaluator, low + parts * (high - low))
    responses = []
    for first in range(0, len(courses), len(steps)):
        twin, *stepped = courses[first : first + len(steps)]
        found = np.array([_response(twin, one) / _STEP for one in stepped])
        responses += [found[:count], -found[count:]]
    ends = [one[-len(one) // _QUARTERS :].mean(axis=0) for one in courses]
    early = np.mean([len(one) < evaluator.most_steps for one in courses])
    return StepResponses(names, np.array(responses), np.array(ends), bool(early > 0.5))


def _played(
    evaluator: CandidateEvaluator, actions: FloatArray
) -> tuple[tuple[str, ...], list[FloatArray]]:
    """Play an episode with each action; returns observations, each of shape (T, k)."""
    controllers: list[_Held] = []
    jobs = []

    def make(rows: FloatArray) -> Controller:
        controllers.append(_Held(rows))
        jobs.append(evaluator.jobs)
        return controllers[-1]

    lengths = evaluator.play(make, actions, [_SEED], has_moments=True).moments[:, 0, 0]
    longest = max(len(one.rows) for one in controllers)
    rows = np.concatenate([one.course(longest) for one in controllers], axis=1)
    places = np.concatenate(jobs).tolist()
    courses = [rows[: int(length), places.index(job)] for job, length in enumerate(lengths)]
    return controllers[0].names, courses


def _response(twin: FloatArray, stepped: FloatArray) -> FloatArray:
    """The difference in the first step, and in the means of quarters, shape (5, k)."""
    length = min(len(twin), len(stepped))
    if length <= FEWEST:
        return np.full((1 + _QUARTERS, twin.shape[1]), np.nan)
    difference = stepped[1:length] - twin[1:length]
    quarters = np.array_split(difference, _QUARTERS)
    return np.stack([difference[0], *(one.mean(axis=0) for one in quarters)])
