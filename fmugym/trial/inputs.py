"""Inputs for trials: they move within their limits and differ between instances."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.pool.base import FloatArray
from fmugym.pool.spec import PoolSpec

__all__ = ["inputs_of_two", "moving_inputs"]

_UNBOUNDED: Final = 1.0
"""How far a Real without limits moves to each side, in its unit."""


def inputs_of_two(spec: PoolSpec, steps: int, amplitude: float) -> FloatArray:
    """The inputs of two instances, different in every step; the second one's move all the way.

    Args:
        spec: Names the inputs.
        steps: The number of steps.
        amplitude: How far those of the first instance move.

    Returns:
        Shape (steps, inputs, 2).
    """
    both = moving_inputs(spec, steps, amplitude), moving_inputs(spec, steps, 1.0, phase=steps)
    return np.stack(both, axis=2)


def moving_inputs(spec: PoolSpec, steps: int, amplitude: float, phase: float = 0.0) -> FloatArray:
    """Make inputs that move from step to step, each at a different pace.

    Args:
        spec: Names the inputs.
        steps: The number of steps.
        amplitude: How far they move, as a fraction of the range on each side of the start value.
        phase: A shift in steps, by which the inputs of one instance differ from those of another.

    Returns:
        Shape (steps, inputs).
    """
    rows = np.empty((steps, len(spec.inputs)))
    for index, variable in enumerate(spec.inputs):
        pace = 0.7 + 0.31 * index
        swing = amplitude * np.sin(pace * (np.arange(steps) + 1.0 + phase))
        rows[:, index] = _moved(variable, swing)
    return rows


def _moved(variable: Variable, swing: FloatArray) -> FloatArray:
    """Values around the start value that swing up to the upper limit and down to the lower one."""
    (low, high), start = variable.range, variable.start_number
    if low <= high:
        start = min(max(start, low), high)
    if variable.kind == "boolean":
        return np.where(swing > 0.3, 1.0 - start, start)
    if variable.items:
        values = np.array(sorted(value for _, value in variable.items), np.float64)
        other = values[(np.arange(len(swing)) % len(values))]
        return np.where(swing > 0.3, other, start)
    room = _UNBOUNDED if variable.kind == "real" else 1.0
    up = high - start if math.isfinite(high) else room
    down = start - low if math.isfinite(low) else room
    values = start + np.where(swing > 0.0, swing * up, swing * down)
    return np.rint(values) if variable.kind == "integer" else values
