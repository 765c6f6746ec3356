"""Derivatives along a trajectory, by central differences over rollouts."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import check_number
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.pool.base import FloatArray
from fmugym.task.snapshot import Snapshot, checked_snapshot
from fmugym.vector.vector_env import FMUVectorEnv, require_open

__all__ = [
    "Derivatives",
    "checked_trajectory",
    "derivatives",
    "differences",
    "float_box",
    "moved_alone",
    "moved_both_ways",
    "precise_step",
    "require_vector",
]


class Derivatives(NamedTuple):
    """Derivatives of a trajectory by its actions.

    The derivative by an action of a later step is 0.

    Attributes:
        observations: Observations of the nominal actions, shape (horizon, outputs).
        rewards: Rewards of the nominal actions, shape (horizon,).
        by_actions: Derivatives of the observations, shape (horizon, outputs, horizon, actions):
            element [t, i, s, j] is that of observation i after step t by action j of step s.
        of_rewards: Derivatives of the rewards, shape (horizon, horizon, actions).
    """

    observations: npt.NDArray[Any]
    rewards: FloatArray
    by_actions: FloatArray
    of_rewards: FloatArray

    @property
    def of_return(self) -> FloatArray:
        """The gradient of the sum of the rewards, shape (horizon, actions)."""
        gradient: FloatArray = self.of_rewards.sum(axis=0)
        return gradient


def derivatives(
    envs: FMUVectorEnv, snapshot: Snapshot, actions: Any, *, step: float | None = None
) -> Derivatives:
    """Differentiate a trajectory by its actions, in one rollout on all threads.

    Each element of each action is moved up and down, and not beyond the bounds of its space. That
    makes 2 horizon actions + 1 candidates of one rollout. Observations of float32 have seven
    digits, so that their derivatives have about four; those of float64 have about ten.

    Args:
        envs: Environments whose observations and actions are boxes of floats, of any shape.
        snapshot: Snapshot of one environment, where the trajectory begins.
        actions: The nominal actions, shape (horizon, ...).
        step: How far actions are moved, as a fraction of the width of the space, or absolute where
            it has no bounds; by default the cube root of the precision of the observations.

    Raises:
        ConfigError: If a space is another one, or the arguments do not fit.
        SimulationError: If an episode ends before the last step, where nothing can be
            differentiated.
    """
    require_vector(envs, "derivatives")
    space = float_box(envs.single_action_space, "action")
    seen = float_box(envs.single_observation_space, "observation")
    checked_snapshot(snapshot, length=1)
    nominal = checked_trajectory(space, actions)
    delta = precise_step(seen) if step is None else check_number("step", step, positive=True)
    candidates, widths = moved_alone(space, nominal, delta)
    found = envs.rollout(snapshot, candidates)
    if found.lengths.min() < len(nominal):
        raise SimulationError(
            f"an episode ends after {found.lengths.min()} of {len(nominal)} steps: derivatives "
            "exist for trajectories without an end only"
        )
    outputs = np.asarray(found.observations, np.float64).reshape(len(candidates), len(nominal), -1)
    by_actions, of_rewards = differences(outputs, widths), differences(found.rewards, widths)
    shape = len(nominal), nominal[0].size
    return Derivatives(
        found.observations[0].reshape(len(nominal), -1),
        found.rewards[0].copy(),
        np.moveaxis(by_actions.reshape(*shape, *outputs.shape[1:]), (0, 1), (2, 3)),
        np.moveaxis(of_rewards.reshape(*shape, len(nominal)), 2, 0),
    )


def precise_step(space: spaces.Box) -> float:
    """The step with the least error of a central difference, for numbers of this precision."""
    dtype: Any = space.dtype
    return float(np.cbrt(float(np.finfo(dtype).eps)))


def float_box(space: Any, what: str) -> spaces.Box:
    """Return a space in which something can be differentiated.

    Raises:
        ConfigError: If it is no box of floats.
    """
    if not isinstance(space, spaces.Box) or space.dtype.kind != "f":
        raise ConfigError(f"derivatives need {what}s in a Box of floats, not in {space}")
    return space


def checked_trajectory(space: spaces.Box, actions: Any) -> npt.NDArray[Any]:
    """Return nominal actions as an array of shape (horizon, ...) and of the type of the space.

    Raises:
        ConfigError: If they do not fit, or are not in the space.
    """
    try:
        nominal = np.array(actions, space.dtype)
    except (TypeError, ValueError):
        nominal = np.empty(0)
    if nominal.shape[1:] != space.shape or nominal.ndim != len(space.shape) + 1 or not nominal.size:
        raise ConfigError(
            f"expected actions of shape (horizon, ...) for {space}, got {shown(actions)}"
        )
    outside = ~((space.low <= nominal) & (nominal <= space.high))
    for step, *place in np.argwhere(outside)[:1].tolist():
        value = nominal[(step, *place)]
        raise ConfigError(f"the action of step {step} is not in {space}: it has {value}")
    return nominal


def require_vector(envs: Any, name: str) -> None:
    """Require an open vector environment.

    Raises:
        ConfigError: If it is something else.
        SimulationError: If it is closed, or a step is under way.
    """
    if not isinstance(envs, FMUVectorEnv):
        raise ConfigError(f"{name} needs an FMUVectorEnv, got {shown(envs)}")
    require_open(envs, name)


def moved_alone(
    space: spaces.Box, nominal: npt.NDArray[Any], step: float
) -> tuple[npt.NDArray[Any], FloatArray]:
    """Nominal actions, two candidates for each element, and the distances of these."""
    *moved, widths = moved_both_ways(space, nominal, step)
    candidates = np.repeat(nominal[None], 2 * nominal.size + 1, axis=0)
    flat = candidates.reshape(len(candidates), -1)
    elements = np.arange(nominal.size)
    for first, values in zip((1, 2), moved, strict=True):
        flat[first + 2 * elements, elements] = values.reshape(-1)
    return candidates, widths.reshape(-1)


def moved_both_ways(
    space: spaces.Box, nominal: npt.NDArray[Any], step: float
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], FloatArray]:
    """Move each element of actions up and down, and not beyond the bounds of the space.

    Args:
        space: Space of one action.
        nominal: Shape (horizon, ...).
        step: How far, as a fraction of the width of the space.

    Returns:
        All moved up, all moved down, and how far these are apart, each of the shape of ``nominal``.
    """
    high, low = (np.broadcast_to(limit, nominal.shape) for limit in (space.high, space.low))
    with np.errstate(over="ignore", invalid="ignore"):
        width = np.subtract(high, low, dtype=np.float64)
    width[~np.isfinite(width)] = 1.0
    up, down = (
        np.clip(nominal + sign * step * width, low, high).astype(nominal.dtype)
        for sign in (1.0, -1.0)
    )
    return up, down, np.subtract(up, down, dtype=np.float64)


def differences(values: npt.NDArray[Any], widths: FloatArray) -> FloatArray:
    """Differences of each pair of candidates, divided by their distances.

    Args:
        values: Results of the candidates of ``moved_alone``, in their order.
        widths: How far they are apart.
    """
    pairs = values[1:].reshape(len(widths), 2, *values.shape[1:])
    apart = widths.reshape(-1, *[1] * (values.ndim - 1))
    quotients: FloatArray = (pairs[:, 0] - pairs[:, 1]) / apart
    return quotients
