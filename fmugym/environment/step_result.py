"""Conclusion of a step of a single environment: results of its hooks from the outputs, and faults.

A fault is an FMU that fails, or a number that is not finite.
"""

from __future__ import annotations

from math import hypot, isfinite
from typing import Any, Final

from fmugym.environment.construction import Constructed
from fmugym.environment.hook_results import FLOAT32_LIMIT, as_info, as_reward
from fmugym.environment.hooks import NUMBERS, call_hooks
from fmugym.errors import SimulationError, shown
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.pool.health import fault_rates

__all__ = [
    "Result",
    "conclude",
    "fault_of_fmu",
    "fault_of_hooks",
    "first_observation",
    "info_of",
    "not_finite",
]

Result = tuple[Any, float, bool, bool, dict[str, Any]]
"""Observation, reward, terminated, truncated and info."""


def info_of(env: Constructed) -> dict[str, Any]:
    """The info of the hook and of the pool."""
    info = as_info(env._get_info())
    if env._instance.tells:
        info = info | {name: value.item(0) for name, value in env._instance.pool.info().items()}
    return info


def fault_of_fmu(env: Constructed, reason: str) -> Result:
    """End the episode because the FMU has failed, with what hooks still read.

    Args:
        env: The environment.
        reason: Of the fault.

    Raises:
        SimulationError: With ``on_fault="raise"``.
    """
    env._ended = True
    policy = env.config.on_fault
    if policy == "raise":
        raise SimulationError(reason)
    env.logger.warning("%s", reason)
    env.done = policy == "terminate"
    rate = float(fault_rates(env._instance.pool.health())[0])
    info = info_of(env) | {"fault": reason, "fault_rate": rate}
    observation = env._get_observation()
    if not env._conversions.is_finite(observation):
        raise SimulationError(f"{reason}; before it the observation is {shown(observation)}")
    return observation, as_reward(env._fault_reward()), env.done, not env.done, info


def fault_of_hooks(
    env: Constructed,
    reward: float,
    observation: Any,
    before: tuple[Any, dict[str, Any] | None],
) -> Result:
    """End the episode because of a number that is not finite, in the state before the step.

    Args:
        env: The environment.
        reward: That of the step.
        observation: The one after the step.
        before: The outputs before the step, and the episode variables if it has changed them.

    Raises:
        SimulationError: With ``on_fault="raise"``.
    """
    reason = not_finite(env, reward, observation)
    read = env._episode
    read.outputs, variables = before
    read.state = read.previous_state
    read.variables.update(variables or {})
    env._instance.pool.note_fault(0)
    env._instance.halt()
    return fault_of_fmu(env, reason)


def not_finite(env: Constructed, reward: float, observation: Any) -> str:
    """Name the number that is not finite, before the step is undone."""
    fine = isfinite(reward)
    what = f"the observation is {shown(observation)}" if fine else env._explain(reward)
    return f"{what} at t = {env.time:g} s"


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
