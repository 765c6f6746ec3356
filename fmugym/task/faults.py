"""Faults of a single environment: an FMU that fails, and numbers that are not finite."""

from __future__ import annotations

from math import isfinite
from typing import Any

from fmugym.errors import SimulationError, shown
from fmugym.pool.health import fault_rates
from fmugym.task.construction import Constructed
from fmugym.task.results import as_info, as_reward

__all__ = ["Result", "fault_of_fmu", "fault_of_hooks", "info_of", "not_finite"]

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
