"""Predictions by a surrogate, compared with the FMU in episodes that the fit has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fmugym.pool.base import FloatArray
from fmugym.surrogate.courses import Course
from fmugym.surrogate.surrogate import Surrogate
from fmugym.surrogate.terms import regressors_of, simulated

if TYPE_CHECKING:
    from fmugym.figures import Figure

__all__ = ["Prediction", "plot_prediction", "predicted"]

_PART: Final = 2
"""Errors are told for horizons up to this part of an episode."""

_UNITS: Final = ((2 * 86400.0, 86400.0, "d"), (2 * 3600.0, 3600.0, "h"), (0.0, 1.0, "s"))
"""From which length on a time is told in which unit."""


class Prediction(NamedTuple):
    """A surrogate beside the FMU.

    Attributes:
        course: An episode of the FMU.
        outputs: Outputs that the surrogate predicts from its beginning on, shape (T + 1, k).
        errors: The root mean square error of predictions that begin everywhere in the episodes,
            by the number of their steps, shape (h, k).
        spread: The standard deviation of the outputs in the episodes, shape (k,).
    """

    course: Course
    outputs: FloatArray
    errors: FloatArray
    spread: FloatArray


def predicted(surrogate: Surrogate, courses: Sequence[Course]) -> Prediction:
    """Predict episodes by a surrogate, from the FMU's inputs and first outputs.

    Args:
        surrogate: The surrogate.
        courses: Courses of the FMU, each with a step at least; the longest one is shown.
    """
    terms, bounds = surrogate.terms, (surrogate.low, surrogate.high)
    longest = max(courses, key=lambda one: one.steps)
    rows = regressors_of(terms.form, longest)[:, None]
    after = [*simulated(terms, [surrogate.weights.T], bounds, rows)]
    outputs = np.concatenate([longest.outputs[:1], np.array(after)[:, :, 0]])
    horizon = max(1, longest.steps // _PART)
    squares = [_squares(surrogate, one, horizon) for one in courses if one.steps >= horizon]
    errors = np.sqrt(np.concatenate(squares, axis=1).mean(axis=1))
    spread = np.concatenate([one.outputs for one in courses]).std(axis=0)
    return Prediction(longest, outputs, errors, spread)


def _squares(surrogate: Surrogate, course: Course, horizon: int) -> FloatArray:
    """The squared errors of predictions from each step on, shape (horizon, n, k)."""
    begins = range(course.steps - horizon + 1)
    rows = regressors_of(surrogate.terms.form, course)
    windows = np.stack([rows[:, one : one + horizon] for one in begins], axis=1)
    true = np.stack([course.outputs[one + 1 :][:horizon] for one in begins], axis=1)
    bounds = surrogate.low, surrogate.high
    after = np.array([*simulated(surrogate.terms, [surrogate.weights.T], bounds, windows)])
    return np.square(after.swapaxes(1, 2) - true)


def plot_prediction(prediction: Prediction, surrogate: Surrogate) -> Figure:
    """Draw an episode beside its prediction, and the errors by horizon.

    Returns:
        A figure of matplotlib, a row for each output. ``figure.savefig(path)`` saves it.
    """
    from fmugym.figures import Figure

    variables, time_step = surrogate.spec.outputs, surrogate.spec.time_step
    length = time_step * prediction.course.steps
    _, scale, unit = next(one for one in _UNITS if length >= one[0])
    count = len(variables)
    figure = Figure(figsize=(9, 1 + 1.8 * count), layout="constrained")
    axes = figure.subplots(count, 2, sharex="col", squeeze=False, width_ratios=[2, 1])
    times = time_step / scale * np.arange(prediction.course.steps + 1)
    horizons = times[1 : len(prediction.errors) + 1]
    for place, (variable, (course, error)) in enumerate(zip(variables, axes, strict=True)):
        course.plot(times, prediction.course.outputs[:, place], color="0.6", lw=2.0, label="FMU")
        course.plot(times, prediction.outputs[:, place], color="#0072b2", lw=1.0, label="surrogate")
        course.set_ylabel(f"{variable.name} [{variable.unit}]" if variable.unit else variable.name)
        error.plot(
            horizons, prediction.errors[:, place], color="#0072b2", label="error of the surrogate"
        )
        error.axhline(prediction.spread[place], color="0.6", ls="--", label="spread of the output")
        error.set_ylim(bottom=0.0)
        for one in (course, error):
            one.grid(alpha=0.3)
    axes[0][0].set_title("an episode that the fit has not seen")
    axes[0][1].set_title("root mean square error")
    axes[-1][0].set_xlabel(f"time [{unit}]")
    axes[-1][1].set_xlabel(f"predicted this long [{unit}]")
    lines = [*axes[0][0].lines, *axes[0][1].lines]
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines))
    return figure
