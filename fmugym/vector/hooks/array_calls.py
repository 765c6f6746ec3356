"""Calls of hooks on the arrays of N environments, or of the expressions in their place."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.task.spaces import to_input_types
from fmugym.vector.hooks import hook_results
from fmugym.vector.infos import observation_of, rows_not_finite

__all__ = [
    "infos_of_hooks",
    "observations_of_hooks",
    "require_finite_start",
    "require_possible_inputs",
    "write_inputs_of_hooks",
]


def observations_of_hooks(env: FMUEnv) -> Any:
    """The observations of all environments, whose prototype this is.

    Raises:
        ConfigError: If the hook returns something unusable.
    """
    count = env._instance.pool.num_instances
    return hook_results.observations(env._get_observation(), env.observation_space, count)


def infos_of_hooks(env: FMUEnv, mask: MaskArray) -> dict[str, Any]:
    """The infos of the hook and of the pool, of the environments in the mask.

    Raises:
        ConfigError: If the hook returns something unusable.
    """
    if not env._conversions.has_info:
        return {}
    infos = hook_results.info_arrays(env._get_info(), mask)
    if env._instance.tells:
        infos |= hook_results.info_arrays(env._instance.pool.info(), mask)
    return infos


def require_finite_start(observations: Any, mask: MaskArray) -> None:
    """Refuse first observations that are not finite.

    Raises:
        SimulationError: If there is one in the mask.
    """
    wrong = rows_not_finite(observations)
    if wrong is not None and (wrong & mask).any():
        index = int(np.flatnonzero(wrong & mask)[0])
        first = shown(observation_of(observations, index))
        raise SimulationError(f"environment {index}: the first observation is not finite: {first}")


def write_inputs_of_hooks(env: FMUEnv, inputs: FloatArray, idle: MaskArray | None) -> None:
    """Write the inputs that the hook returns, in the types of the FMU's variables.

    Args:
        env: The prototype.
        inputs: Where they go, shape (m, N).
        idle: Which environments do not step, shape (N,); None if all do.

    Raises:
        ConfigError: If an environment that steps has an input that is not finite or does not fit
            its type.
    """
    hook_results.write_inputs(env._get_inputs(), inputs)
    if not env._conversions.input_writer.all_real:
        for index in _stepping(inputs, idle):
            inputs[:, index] = to_input_types(env.interface.inputs, inputs[:, index])
    _require_finite(inputs, idle)


def require_possible_inputs(env: FMUEnv, idle: MaskArray | None) -> None:
    """Refuse inputs that are not finite, which they also are outside of their type's range.

    Args:
        env: The prototype.
        idle: Which environments do not step, shape (N,); None if all do.

    Raises:
        ConfigError: If there is such an input.
    """
    inputs = env._instance.pool.inputs
    if not env._conversions.input_writer.all_real and not np.isfinite(inputs).all():
        write_inputs_of_hooks(env, np.array(inputs), idle)
    _require_finite(inputs, idle)


def _stepping(inputs: FloatArray, idle: MaskArray | None) -> list[int]:
    """The indices of the environments that step."""
    return [i for i in range(inputs.shape[1]) if idle is None or not idle[i]]


def _require_finite(inputs: FloatArray, idle: MaskArray | None) -> None:
    if isfinite(np.vdot(inputs, inputs)):  # half the time of what follows
        return
    finite = np.isfinite(inputs)
    for index in _stepping(inputs, idle):
        if not finite[:, index].all():
            raise ConfigError(f"an input of environment {index} is not finite: {inputs[:, index]}")
