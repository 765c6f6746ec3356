"""Rollouts of many candidates for the next actions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError, SimulationError
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.bundle import IndexArray
from fmugym.task.snapshot import Snapshot, checked_snapshot
from fmugym.vector.candidates import Candidates
from fmugym.vector.episodes import Episodes
from fmugym.vector.info_arrays import mapped
from fmugym.vector.infos import copy_rows
from fmugym.vector.tasks import StepResult, VectorTask

__all__ = [
    "Rollout",
    "costs_in",
    "joined_rollouts",
    "returning_to",
    "roll_out",
    "start_of_rollout",
]


class _Steps(NamedTuple):
    observations: Any
    rewards: FloatArray
    terminated: MaskArray
    truncated: MaskArray
    lengths: npt.NDArray[np.int64]


class Rollout(_Steps):
    """Results of n candidates in up to ``horizon`` steps.

    It is a tuple of the first five attributes.

    After the end of a candidate's episode its last observation is repeated, its rewards are 0, and
    the flags are False.

    Attributes:
        observations: After each step, shape (n, horizon, ...), or a dict or tuple of such arrays.
        rewards: Shape (n, horizon), float64.
        terminated: Whether the step has ended the episode, shape (n, horizon).
        truncated: Whether the step has cut it short, shape (n, horizon).
        lengths: The steps that each candidate has done, shape (n,).
        costs: The numbers that infos tell as ``"costs"``, by name, each of shape (n, horizon); 0
            after the end.
        has_failed: Whether a fault has ended the episode, shape (n,).
    """

    costs: Mapping[str, FloatArray] = MappingProxyType({})
    has_failed: MaskArray

    @classmethod
    def of(
        cls,
        observations: Any,
        rewards: FloatArray,
        terminated: MaskArray,
        truncated: MaskArray,
        costs: Mapping[str, FloatArray],
        has_failed: MaskArray,
    ) -> Rollout:
        """Make it of arrays with steps on the first axis."""
        ends = terminated | truncated
        horizon = len(rewards)
        first = ends.argmax(axis=0) + 1 if horizon else np.zeros(rewards.shape[1], np.int64)
        lengths = np.where(ends.any(axis=0), first, horizon)
        turned = mapped(lambda array: np.swapaxes(array, 0, 1), observations)
        runs = np.arange(horizon)[:, np.newaxis] < lengths
        found = cls(turned, rewards.T, terminated.T, truncated.T, lengths)
        found.costs = {name: np.where(runs, paid, 0.0).T for name, paid in costs.items()}
        found.has_failed = has_failed
        return found


def costs_in(infos: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, FloatArray]:
    """The costs that infos of environments tell, by name.

    Args:
        infos: Those of a step.
        shape: That of the rewards. What a class tells as ``"costs"`` in another shape, or as no
            numbers, is its own affair.
    """
    told = infos.get("costs")
    return {
        name: paid
        for name, paid in (told.items() if isinstance(told, dict) else ())
        if not str(name).startswith("_")  # which says whose costs are told
        and isinstance(paid, np.ndarray)
        and paid.shape == shape
        and paid.dtype.kind in "biuf"
    }


def joined_rollouts(parts: Sequence[Rollout], count: int) -> Rollout:
    """Put rollouts together, and keep the first candidates."""
    if len(parts) == 1 and len(parts[0].rewards) == count:
        return parts[0]
    joined = Rollout._make(
        mapped(lambda *arrays: np.concatenate(arrays)[:count], *part)
        for part in zip(*parts, strict=True)
    )
    joined.costs = {
        name: np.concatenate([one.costs.get(name, 0.0 * one.rewards) for one in parts])[:count]
        for name in dict.fromkeys(name for one in parts for name in one.costs)
    }
    joined.has_failed = np.concatenate([one.has_failed for one in parts])[:count]
    return joined


def start_of_rollout(
    episodes: Episodes, snapshot: Snapshot | None, present: Snapshot | None, count: int
) -> Snapshot:
    """Start of candidates: the snapshot that was given, or else the present episodes.

    Raises:
        ConfigError: If the snapshot does not fit, or not so many candidates.
        SimulationError: If there is none, or an episode in it has ended.
    """
    if snapshot is None and present is None:
        raise SimulationError("rollout without a snapshot was called before the first reset")
    start = checked_snapshot(present if snapshot is None else snapshot)
    if len(start) not in ((count,) if snapshot is None else (1, count)):
        raise ConfigError(
            f"there are {count} candidates, but {len(start)} episodes where they may begin"
        )
    columns = episodes.columns_of(start)
    episodes.require_fit(columns)
    if np.any(columns["ended"]):
        raise SimulationError("an episode where candidates begin has ended: reset it first")
    return start


@contextmanager
def returning_to(episodes: Episodes, present: Snapshot | None) -> Iterator[None]:
    """Return to the present episodes afterwards, or to none."""
    try:
        yield
    finally:
        episodes.is_ready = False
        if present is not None:
            episodes.go_on_from(present, episodes.everywhere)
            episodes.is_ready = True


def roll_out(task: VectorTask, start: Snapshot, candidates: Candidates) -> Rollout:
    """Let the environments play all candidates, as many at a time as there are environments.

    Args:
        task: That of the environments.
        start: Where the candidates begin, see ``start_of_rollout``.
        candidates: The candidates.
    """
    with task.assuming(candidates.tables, candidates.offsets):
        parts = [_play(task, start, places, candidates) for places in candidates.rounds]
    return joined_rollouts(parts, candidates.count)


def _play(task: VectorTask, start: Snapshot, places: IndexArray, candidates: Candidates) -> Rollout:
    """Let each environment play the candidate at its place, until all of these have ended."""
    actions, episodes = candidates.actions(places), task.episodes
    _begin(episodes, start, places, candidates)
    observations = None if actions is not None else task.observe(episodes.everywhere)
    act = candidates.act(actions)
    arrays = _Arrays(candidates.horizon, len(places))
    for step in range(candidates.horizon):
        resting = episodes.ended.copy() if episodes.any_ended else None
        if resting is not None and resting.all():
            arrays.repeat_last(step)
            break
        result = task.step(act(step, observations), resting=resting)
        if resting is not None:
            result = _without(result, observations, resting)
        arrays.keep(step, result, resting)
        observations = result[0]
    return arrays.rollout()


def _begin(episodes: Episodes, start: Snapshot, places: IndexArray, candidates: Candidates) -> None:
    """Bring all environments to the places where candidates begin."""
    sources = places if len(start) > 1 else np.zeros_like(places)
    episodes.restore(start.bundle, sources, episodes.everywhere)
    columns = candidates.seen_in(episodes.columns_of(start))
    episodes.place(columns, sources, episodes.everywhere)
    values = {name: column[places] for name, column in candidates.parameters.items()}
    if values:
        variables = tuple(map(episodes.prototype.fmu.variable, values))
        episodes.pool.write(variables, np.stack(list(values.values())))
    episodes.show(candidates.variables, values)


class _Arrays:
    """Results of a rollout, in arrays with the steps on the first axis.

    Args:
        horizon: The number of steps.
        count: N.
    """

    def __init__(self, horizon: int, count: int) -> None:
        self._horizon = horizon
        self._observations: Any = None
        self._rewards = np.zeros((horizon, count))
        self._terminated, self._truncated = np.zeros((2, horizon, count), np.bool_)
        self._costs: dict[str, FloatArray] = {}
        self._has_failed = np.zeros(count, np.bool_)

    def keep(self, step: int, result: StepResult, resting: MaskArray | None) -> None:
        """Keep the result of a step."""
        observed, rewards, terminated, truncated, infos = result
        if step == 0:
            self._observations = mapped(self._room_for, observed)
        if type(observed) is np.ndarray:  # no tree to search through
            self._observations[step] = observed
        else:
            mapped(partial(_put, step), self._observations, observed)
        self._rewards[step] = rewards
        self._terminated[step] = terminated
        self._truncated[step] = truncated
        if infos:
            self._keep_infos(step, infos, resting)

    def _keep_infos(self, step: int, infos: Mapping[str, Any], resting: MaskArray | None) -> None:
        for name, paid in costs_in(infos, self._has_failed.shape).items():
            if name not in self._costs:
                self._costs[name] = np.zeros_like(self._rewards)
            self._costs[name][step] = paid
        if "_fault" in infos:
            self._has_failed |= infos["_fault"] if resting is None else infos["_fault"] & ~resting

    def _room_for(self, part: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.empty((self._horizon, *part.shape), part.dtype)

    def repeat_last(self, step: int) -> None:
        """Let nothing happen from a step on."""
        mapped(lambda rows: _put(slice(step, None), rows, rows[step - 1]), self._observations)

    def rollout(self) -> Rollout:
        """The rollout of these steps."""
        judged = self._rewards, self._terminated, self._truncated
        return Rollout.of(self._observations, *judged, self._costs, self._has_failed)


def _put(step: int | slice, rows: npt.NDArray[Any], part: npt.NDArray[Any]) -> None:
    rows[step] = part


def _without(result: StepResult, before: Any, over: MaskArray) -> StepResult:
    """Leave out the environments whose candidates have ended earlier."""
    observations, rewards, terminated, truncated, _ = result
    copy_rows(before, observations, over)
    rewards[over] = 0.0
    terminated[over] = truncated[over] = False
    return result
