"""Shift between the clocks of inputs and outputs, which looks like a wrong model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from fmugym.errors import ConfigError, SimulationError
from fmugym.identification.comparison import Comparison
from fmugym.identification.output_error import FitResult, fit_of
from fmugym.identification.trajectory import Trajectory
from fmugym.pool.base import FloatArray

__all__ = ["Shift", "shift_of_clocks"]

_ROUNDS: Final = 8
"""Number of times that values and the shift are fitted in turn."""

_LARGEST_GAIN: Final = 10.0
"""Largest ratio of the next step to the next change."""

_SAME: Final = 0.02
"""A change of the shift, in sampling intervals, that is too small for another round."""

_BETTER: Final = 0.5
"""The squares of the residuals must become smaller by this factor, or the model is wrong."""

_FARTHEST: Final = 50
_OF_THE_LOG: Final = 0.1
"""A shift is looked for within so many intervals, and within this part of the shortest log."""

_FINE: Final = 8
"""Shifts that are tried in each interval."""


class Shift(NamedTuple):
    """Delay of the logged outputs, and the part of the residuals that it explains.

    Attributes:
        seconds: By how much the times of the outputs are later than those of the inputs.
        improvement: The factor by which residuals are smaller with other times.
    """

    seconds: float
    improvement: float


def shift_of_clocks(fit: FitResult, trajectories: Sequence[Trajectory]) -> Shift | None:
    """Estimate a shift of clocks, if it explains more than half of the squares of residuals.

    Values are fitted again with the outputs at other times, since a wrong shift distorts them.

    Args:
        fit: A fit whose residuals are no noise.
        trajectories: Trajectories of the fit.

    Returns:
        The shift; None if there is none, or no input tells of it.
    """
    is_told = any(np.ptp(values) > 0 for one in trajectories for values in one.inputs.values())
    interval = min(float(np.median(np.diff(one.time))) for one in trajectories)
    most = min(_FARTHEST * interval, _OF_THE_LOG * min(float(np.ptp(t.time)) for t in trajectories))
    if not is_told or most < interval:
        return None
    found, seconds, step, before = fit, 0.0, 0.0, 0.0
    for _ in range(_ROUNDS):
        change = _best_shift(found.comparison, interval, most)
        if abs(change) < _SAME * interval:
            break
        # Values follow a wrong shift, so that each change is too small: a secant tells by how much.
        gain = step / (before - change) if step and before != change else 1.0
        last, before = seconds, change
        seconds = float(np.clip(last + np.clip(gain, 1.0, _LARGEST_GAIN) * change, -most, most))
        step = seconds - last
        try:
            found = _fitted(fit, found, trajectories, seconds)
        except (ConfigError, SimulationError):  # too few rows are left, or the FMU fails
            return None
    ratio = _size(found.comparison) / _size(fit.comparison)
    if not seconds or not ratio < _BETTER:
        return None
    return Shift(seconds, float(1.0 / np.sqrt(ratio)))


def _fitted(
    fit: FitResult,
    last: FitResult,
    trajectories: Sequence[Trajectory],
    seconds: float,
) -> FitResult:
    """Fit from the last values on, with the outputs as they were some seconds earlier."""
    limits = {n: (v, *fit.bounds[n]) for n, v in last.values.items()}
    wash_in = max(fit.experiment.wash_in or 0.0, -seconds)
    experiment = replace(fit.experiment, wash_in=wash_in)
    return fit_of(experiment, limits, [_moved(t, seconds) for t in trajectories], 1)


def _moved(trajectory: Trajectory, seconds: float) -> Trajectory:
    """The outputs of some seconds later at each time; the rows at the end have none."""
    time = trajectory.time
    outputs = {n: np.interp(time + seconds, time, v) for n, v in trajectory.outputs.items()}
    return replace(trajectory, outputs=outputs).select(time + seconds <= time[-1])


def _size(comparison: Comparison) -> float:
    """The mean square of the residuals, in units of the variance of each output."""
    names = comparison.trajectories[0].outputs
    return float(np.mean([1.0 - comparison.explained(name) for name in names]))


def _best_shift(comparison: Comparison, interval: float, most: float) -> float:
    """The shift of the measured outputs with the smallest residuals, all else equal."""
    shifts = np.arange(-most, most + interval / _FINE, interval / _FINE)
    sizes = np.array([_residual(comparison, one) for one in shifts])
    place = int(np.argmin(sizes))
    if not 0 < place < len(shifts) - 1:
        return float(shifts[place])
    before, least, after = sizes[place - 1 : place + 2]
    bend = before - 2.0 * least + after  # of the parabola through the three
    offset = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(shifts[place] + offset * interval / _FINE)


def _residual(comparison: Comparison, seconds: float) -> float:
    parts: list[FloatArray] = []
    for measured, simulated in zip(comparison.trajectories, comparison.simulated, strict=True):
        later = measured.time + seconds
        within = (later >= measured.time[0]) & (later <= measured.time[-1])
        for name, values in measured.outputs.items():
            spread = float(np.std(values)) or 1.0
            moved = np.interp(later[within], measured.time, values)
            parts.append((moved - simulated[name][within]) / spread)
    return float(np.mean(np.concatenate(parts) ** 2))
