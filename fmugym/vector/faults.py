"""Faults in a step of N environments on arrays: failures, and numbers that are not finite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fmugym.errors import SimulationError, shown
from fmugym.fmi.status import TERMINATED_CODE
from fmugym.pool.base import MaskArray
from fmugym.pool.health import fault_rates
from fmugym.pool.licences import require_started
from fmugym.task.faults import not_finite
from fmugym.vector.codec import coded, with_masks
from fmugym.vector.hooks import hook_results
from fmugym.vector.infos import copy_rows, observation_of, rows_not_finite
from fmugym.vector.tasks import StepResult, failed_in

if TYPE_CHECKING:
    from fmugym.vector.expressions import Expressions

__all__ = ["settle"]


def settle(task: Expressions, result: StepResult, troubled: int, started: MaskArray | None) -> None:
    """Find numbers that are not finite, and handle them and failures.

    They are rare, so that numpy is fast enough.

    Args:
        task: The task.
        result: Of the step; it is corrected.
        troubled: How many FMUs have a status worse than a warning, or numbers that a program found
            not finite.
        started: Which environments have started an episode in this step; None for none.

    Raises:
        ConfigError: If an input is not finite.
        SimulationError: If an episode cannot start, or after a fault with ``on_fault="raise"``.
    """
    episodes = task.episodes
    rewards = rows_not_finite(result.rewards)
    is_told = task.env._conversions.pool_observes and not troubled
    observations = None if is_told else rows_not_finite(result.observations)
    if not troubled and rewards is None and observations is None:
        return
    if started is not None:
        require_started(episodes.pool, np.flatnonzero(started))
        task.require_finite_start(result.observations, started)
    task.require_possible_inputs(started)
    _handle(task, result, (rewards, observations))
    episodes.note_ends(result.terminated, result.truncated)
    if started is not None:
        episodes.note_starts(started)


def _handle(
    task: Expressions, result: StepResult, wrong: tuple[MaskArray | None, MaskArray | None]
) -> None:
    """Handle FMUs that failed or asked to stop, and numbers that are not finite.

    Args:
        task: The task.
        result: Of the step.
        wrong: Where rewards and observations are not finite.
    """
    pool = task.episodes.pool
    stopped, failed = pool.statuses == TERMINATED_CODE, failed_in(pool.statuses)
    if stopped.any():
        result.infos.update(with_masks({"fmu_terminated": stopped}, stopped))
    reasons = {index: pool.failure(index) for index in np.flatnonzero(failed).tolist()}
    for rows in wrong:
        for index in _indices(rows, ~failed):
            reasons[index] = _not_finite(task, result, index)
    if reasons:
        _end(task, result, dict(sorted(reasons.items())), failed)


def _not_finite(task: Expressions, result: StepResult, index: int) -> str:
    observation = observation_of(result.observations, index)
    with task.episodes.single(index) as env:
        return not_finite(env, result.rewards[index], observation)


def _end(
    task: Expressions, result: StepResult, reasons: Mapping[int, str], failed: MaskArray
) -> None:
    """End the episodes of some environments, in the state before the step."""
    env, config, count = task.env, task.env.config, len(failed)
    faulty = np.zeros(count, np.bool_)
    faulty[list(reasons)] = True
    if config.on_fault == "raise":
        index, reason = next(iter(reasons.items()))
        raise SimulationError(f"environment {index}: {reason}")
    for index, reason in reasons.items():
        env.logger.warning("environment %d: %s", index, reason)
    env.done[faulty] = config.on_fault == "terminate"
    undone = faulty & ~failed
    if undone.any():
        task.episodes.undo(undone)
    if undone.any() or env._conversions.has_info or not env._conversions.pool_observes:
        _see_again(task, result, faulty, reasons)
    texts = np.full(count, None, dtype=object)
    texts[faulty] = list(reasons.values())
    rates = fault_rates(task.episodes.pool.health())
    result.infos.update(coded({"fault": texts, "fault_rate": rates}, faulty))
    result.rewards[faulty] = hook_results.rewards(env._fault_reward(), count)[faulty]
    result.terminated[faulty] = config.on_fault == "terminate"
    result.truncated[faulty] = config.on_fault == "truncate"


def _see_again(
    task: Expressions, result: StepResult, mask: MaskArray, reasons: Mapping[int, str]
) -> None:
    """Observe environments in the state before a step, with ``done`` of their fault."""
    again = task.observations()
    for index in _indices(rows_not_finite(again), mask):
        before = shown(observation_of(again, index))
        raise SimulationError(
            f"environment {index}: {reasons[index]}; before it the observation is {before}"
        )
    copy_rows(again, result.observations, mask)
    if task.env._conversions.has_info:
        infos = task.infos(np.ones(len(mask), np.bool_))
        copy_rows(infos, {name: result.infos[name] for name in infos}, mask)


def _indices(rows: MaskArray | None, mask: MaskArray) -> list[int]:
    """The indices of the environments in both masks; None stands for an empty mask."""
    return [] if rows is None else np.flatnonzero(rows & mask).tolist()
