"""Faults in a step of N environments on arrays: failures, and numbers that are not finite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fmugym.environment.step_result import not_finite
from fmugym.environment.vector import array_results
from fmugym.environment.vector.array_episodes import ArrayEpisodes
from fmugym.environment.vector.array_results import (
    infos_of_hooks,
    observations_of_hooks,
    require_finite_start,
    require_possible_inputs,
)
from fmugym.environment.vector.infos import (
    coded,
    copy_rows,
    observation_of,
    rows_not_finite,
    with_masks,
)
from fmugym.environment.vector.tasks import StepResult, failed_in
from fmugym.errors import SimulationError, shown
from fmugym.fmi.status import TERMINATED_CODE
from fmugym.pool.health import fault_rates
from fmugym.pool.licences import require_started
from fmugym.pool.pool import FloatArray, MaskArray

__all__ = ["settle_faults"]


class _Result(NamedTuple):
    observations: Any
    rewards: FloatArray
    terminated: MaskArray
    truncated: MaskArray
    infos: dict[str, Any]


def settle_faults(
    episodes: ArrayEpisodes, of_step: StepResult, troubled: int, started: MaskArray | None
) -> None:
    """Find numbers that are not finite, and handle them and failures.

    They are rare, so that numpy is fast enough.

    Args:
        episodes: The episodes.
        of_step: The result of the step; its arrays and infos are corrected.
        troubled: How many FMUs have a status worse than a warning, or numbers that a program found
            not finite.
        started: Which environments have started an episode in this step; None for none.

    Raises:
        ConfigError: If an input is not finite.
        SimulationError: If an episode cannot start, or after a fault with ``on_fault="raise"``.
    """
    env = episodes.prototype
    result = _Result(*of_step)
    rewards = rows_not_finite(result.rewards)
    is_told = env._conversions.pool_observes and not troubled
    observations = None if is_told else rows_not_finite(result.observations)
    if not troubled and rewards is None and observations is None:
        return
    if started is not None:
        require_started(episodes.pool, np.flatnonzero(started))
        require_finite_start(result.observations, started)
    require_possible_inputs(env, started)
    _handle(episodes, result, (rewards, observations))
    episodes.note_ends(result.terminated, result.truncated)
    if started is not None:
        episodes.note_starts(started)


def _handle(
    episodes: ArrayEpisodes, result: _Result, wrong: tuple[MaskArray | None, MaskArray | None]
) -> None:
    """Handle FMUs that failed or asked to stop, and numbers that are not finite.

    Args:
        episodes: The episodes.
        result: Of the step.
        wrong: Where rewards and observations are not finite.
    """
    pool = episodes.pool
    stopped, failed = pool.statuses == TERMINATED_CODE, failed_in(pool.statuses)
    if stopped.any():
        result.infos.update(with_masks({"fmu_terminated": stopped}, stopped))
    reasons = {index: pool.failure(index) for index in np.flatnonzero(failed).tolist()}
    for rows in wrong:
        for index in _indices(rows, ~failed):
            reasons[index] = _not_finite(episodes, result, index)
    if reasons:
        _end(episodes, result, dict(sorted(reasons.items())), failed)


def _not_finite(episodes: ArrayEpisodes, result: _Result, index: int) -> str:
    observation = observation_of(result.observations, index)
    with episodes.single(index) as env:
        return not_finite(env, result.rewards[index], observation)


def _end(
    episodes: ArrayEpisodes, result: _Result, reasons: Mapping[int, str], failed: MaskArray
) -> None:
    """End the episodes of some environments, in the state before the step."""
    env, count = episodes.prototype, len(failed)
    on_fault = env.config.on_fault
    faulty = np.zeros(count, np.bool_)
    faulty[list(reasons)] = True
    if on_fault == "raise":
        index, reason = next(iter(reasons.items()))
        raise SimulationError(f"environment {index}: {reason}")
    for index, reason in reasons.items():
        env.logger.warning("environment %d: %s", index, reason)
    env.done[faulty] = on_fault == "terminate"
    undone = faulty & ~failed
    if undone.any():
        episodes.undo(undone)
    if undone.any() or env._conversions.has_info or not env._conversions.pool_observes:
        _see_again(episodes, result, faulty, reasons)
    texts = np.full(count, None, dtype=object)
    texts[faulty] = list(reasons.values())
    rates = fault_rates(episodes.pool.health())
    result.infos.update(coded({"fault": texts, "fault_rate": rates}, faulty))
    result.rewards[faulty] = array_results.rewards(env._fault_reward(), count)[faulty]
    result.terminated[faulty] = on_fault == "terminate"
    result.truncated[faulty] = on_fault == "truncate"


def _see_again(
    episodes: ArrayEpisodes, result: _Result, mask: MaskArray, reasons: Mapping[int, str]
) -> None:
    """Observe environments in the state before a step, with ``done`` of their fault."""
    env = episodes.prototype
    again = observations_of_hooks(env)
    for index in _indices(rows_not_finite(again), mask):
        before = shown(observation_of(again, index))
        raise SimulationError(
            f"environment {index}: {reasons[index]}; before it the observation is {before}"
        )
    copy_rows(again, result.observations, mask)
    if env._conversions.has_info:
        infos = infos_of_hooks(env, np.ones(len(mask), np.bool_))
        copy_rows(infos, {name: result.infos[name] for name in infos}, mask)


def _indices(rows: MaskArray | None, mask: MaskArray) -> list[int]:
    """The indices of the environments in both masks; None stands for an empty mask."""
    return [] if rows is None else np.flatnonzero(rows & mask).tolist()
