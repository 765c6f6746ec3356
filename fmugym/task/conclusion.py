"""Conclusion of a step of a single environment: what its hooks make of the FMU's outputs."""

from __future__ import annotations

from math import hypot, isfinite
from typing import Any, Final

from fmugym.errors import SimulationError, shown
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.task.construction import Constructed
from fmugym.task.faults import Result, fault_of_fmu, fault_of_hooks, info_of
from fmugym.task.results import FLOAT32_LIMIT
from fmugym.task.step import NUMBERS, call_hooks

__all__ = ["conclude", "first_observation"]

_TERMINATED: Final = int(Status.TERMINATED)


def conclude(env: Constructed, status: int, values: tuple[float, ...] | None = None) -> Result:
    """Make the result of a step of the FMU.

    Args:
        env: The environment.
        status: That of the step.
        values: The outputs; None for those that the pool has.

    Raises:
        ConfigError: If a hook returns something unusable.
        SimulationError: After a fault with ``on_fault="raise"``.
    """
    read, instance, conversions = env._episode, env._instance, env._conversions
    read.fmu_status, stopped = status, False
    if status:
        stopped = status == _TERMINATED
        if status > WARNING_CODE and not stopped:
            return fault_of_fmu(env, instance.pool.failure(0))
    variables = read.variables.copy() if env._own_hooks.update else None
    before = read.outputs
    if values is None:
        values = tuple(instance.outputs.tolist())  # Python's floats are faster
    read.outputs = values
    read.state = values[: read.width]
    observed = instance.observation.copy() if conversions.pool_observes else None
    cut_off = read.step_count >= env.step_limit
    observation, reward, terminated, truncated = call_hooks(
        env, NUMBERS, stopped, cut_off, observed
    )
    # One call for all numbers, which is enough for nearly all steps.
    is_small = observed is not None and hypot(reward, *values) <= FLOAT32_LIMIT
    if not is_small and not (isfinite(reward) and conversions.is_finite(observation)):
        return fault_of_hooks(env, reward, observation, (before, variables))
    info = info_of(env) if conversions.has_info else {}
    if stopped:
        info["fmu_terminated"] = True
    if terminated or truncated:
        env._ended = True
    return observation, reward, terminated, truncated, info


def first_observation(env: Constructed) -> tuple[Any, dict[str, Any]]:
    """The observation and the info of an episode that begins, or goes on from a snapshot.

    Raises:
        ConfigError: If a hook returns something unusable.
        SimulationError: If the observation is not finite.
    """
    observation = env._get_observation()
    if not env._conversions.is_finite(observation):
        raise SimulationError(f"the first observation is not finite: {shown(observation)}")
    return observation, info_of(env) if env._conversions.has_info else {}
