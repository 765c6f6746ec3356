"""Fit of a surrogate to the trajectories of an FMU.

Its predictions are compared with the FMU in episodes that the fit has not seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from fmugym.control.surrogate.recorded_trajectories import EpisodeTrajectory, Trajectories
from fmugym.control.surrogate.surrogate import Surrogate
from fmugym.control.surrogate.terms import Start, SurrogateForm, Terms, regressors_of, simulated
from fmugym.errors import ConfigError
from fmugym.pool.pool import FloatArray

if TYPE_CHECKING:
    from fmugym.rendering.figures import Figure

__all__ = ["Prediction", "fit", "plot_prediction", "predicted"]

_FOLDS: Final = 3
_PENALTIES: Final = (1e-8, 1e-6, 1e-4, 1e-2)
_HORIZON: Final = 48
"""The steps of a simulation, at most; a quarter of the longest trajectory is enough."""

_TIE: Final = 0.95
"""A larger model must have less than this part of the error of a smaller one."""

_LAGS: Final = 4
_TANHS: Final = 60
_GRID: Final = 15
_BEYOND: Final = 0.2
"""Outputs stay in their range in the trajectories, which is so much wider on both sides."""

_FEW: Final = 5
"""An output may be limited if it is so often at an end of its range, after a step."""


def fit(trajectories: Trajectories) -> Surrogate:
    """Fit a surrogate.

    Forms compete by the errors of simulations of trajectories that the fit has not seen. They begin
    with the linear one; what lessens the error most is added until nothing does.

    Raises:
        ConfigError: If there are no steps.
    """
    data = _Data(trajectories)
    best, form = data.trial(data.linear), data.linear
    while True:
        found = [(*data.trial(one), one) for one in data.extensions(form)]
        if not found:
            break
        error, penalty, larger = min(found, key=itemgetter(0))
        if not error < _TIE * best[0]:
            break
        best, form = (error, penalty), larger
    return data.fitted(form, *best)


class _Data:
    """Trajectories of a fit, and the trajectories that each fold leaves out."""

    def __init__(self, trajectories: Trajectories) -> None:
        spec = trajectories.spec
        self.all = [one for one in trajectories.all() if one.steps]
        if not self.all or spec is None:
            raise ConfigError("a surrogate needs trajectories with steps")
        self.trajectories, self.spec = trajectories, spec
        self.widths = len(spec.outputs), len(spec.inputs)
        angles = [i for i, one in enumerate(spec.outputs) if one.unit == "rad"]
        self.linear = SurrogateForm(angles=tuple(angles))
        changes = np.concatenate([np.diff(one.outputs, axis=0) for one in self.all])
        size = changes.std(axis=0)
        self.size = np.where(size > 0.0, size, 1.0)
        everything = np.concatenate([one.outputs for one in self.all])
        self.spread = np.where(np.ptp(everything, axis=0) > 0.0, everything.std(axis=0), 1.0)
        self.spread[angles] = 1.0
        self.ends = everything.min(axis=0), everything.max(axis=0)
        after = np.concatenate([one.outputs[1:] for one in self.all])
        self.at_an_end = (after == self.ends[0]) | (after == self.ends[1])
        self.horizon = max(1, min(_HORIZON, max(one.steps for one in self.all) // 4))

    def bounds(self, form: SurrogateForm) -> tuple[FloatArray, FloatArray]:
        """Bounds of outputs: a little beyond their ranges; limited outputs stay within theirs."""
        low, high = self.ends
        beyond = _BEYOND * (high - low)
        beyond[[*form.limited]], beyond[[*form.angles]] = 0.0, np.inf
        return low - beyond, high + beyond

    def extensions(self, form: SurrogateForm) -> Iterator[SurrogateForm]:
        """The forms that have one thing more."""
        if form.lags < min(_LAGS, self.horizon - 1):
            yield replace(form, lags=form.lags + 1)
        if not form.quadratic:
            yield replace(form, quadratic=True)
        if not form.tanhs:
            yield replace(form, tanhs=_TANHS)
        if not form.starts and len({one.starts.tobytes() for one in self.all}) > 2 * _FOLDS:
            yield replace(form, starts=True)
        for place in np.flatnonzero(self.at_an_end.sum(axis=0) >= _FEW).tolist():
            if place not in (*form.limited, *form.angles):
                yield replace(form, limited=(*form.limited, place))
        if len(form.thresholds) < self.widths[1]:
            found = self._threshold(form)
            if found is not None:
                yield form.with_threshold(*found)

    # The fit of one form.

    def _matrices(
        self, form: SurrogateForm, trajectories: Sequence[EpisodeTrajectory]
    ) -> tuple[FloatArray, FloatArray]:
        first = form.lags  # before this step, what a trajectory begins with does not tell its past
        rows = np.concatenate([regressors_of(form, one)[:, first:] for one in trajectories], axis=1)
        changes = np.concatenate([np.diff(one.outputs, axis=0)[first:] for one in trajectories])
        return rows, changes / self.size

    def _weights(
        self,
        form: SurrogateForm,
        trajectories: Sequence[EpisodeTrajectory],
        penalties: Sequence[float],
    ) -> tuple[Terms, list[FloatArray]]:
        """The terms, and for each penalty the weights, shape (f, k)."""
        rows, changes = self._matrices(form, trajectories)
        terms = Terms.fitted_to(form, rows, self.widths)
        values = terms.values(rows)
        found = np.zeros((len(penalties), len(values), len(self.size)))
        for place, change in enumerate(changes.T):
            after = (rows[place] + change * self.size[place])[None]
            low, high = self.ends[0][place], self.ends[1][place]
            counts = (low < after) & (after < high) if place in form.limited else np.ones((1, 1))
            square, right = (values * counts) @ values.T, (values * counts) @ change
            for number, penalty in enumerate(penalties):
                ridge = penalty * rows.shape[1] * np.eye(len(square))
                ridge[0, 0] *= 1e-6  # the constant
                found[number, :, place] = np.linalg.solve(square + ridge, right) * self.size[place]
        return terms, [*found]

    def trial(self, form: SurrogateForm) -> tuple[float, float]:
        """The smallest mean error of simulations, and the penalty that has it."""
        errors = np.array([self._fold(form, number) for number in range(_FOLDS)])
        mean = np.nan_to_num(errors, nan=np.inf).mean(axis=0)
        return float(mean.min()), _PENALTIES[int(mean.argmin())]

    def _fold(self, form: SurrogateForm, number: int) -> FloatArray:
        """The error of each penalty in the trajectories of one fold."""
        kept, left = self._split(number)
        terms, weights = self._weights(form, kept, _PENALTIES)
        return _simulation_errors(terms, weights, left, self.horizon, self)

    def _split(self, number: int) -> tuple[list[EpisodeTrajectory], list[EpisodeTrajectory]]:
        """Trajectories of a fit, and trajectories for its test."""
        long = [one for one in self.all if one.steps >= self.horizon] or self.all
        pieces = self.all if len(long) >= 2 * _FOLDS else list(_pieces(self.all, 2 * self.horizon))
        left = [one for place, one in enumerate(pieces) if place % _FOLDS == number]
        kept = [one for place, one in enumerate(pieces) if place % _FOLDS != number]
        return kept or pieces, left or pieces

    def _threshold(self, form: SurrogateForm) -> tuple[int, float] | None:
        """The threshold of an input that explains most of a step, beside linear terms."""
        small = replace(form, tanhs=0, quadratic=False)
        rows, changes = self._matrices(small, self.all)
        terms = Terms.fitted_to(small, rows, self.widths)
        values = terms.values(rows)
        linear = values[: 1 + terms.factor_count]
        best = np.inf, 0, 0.0
        for place in range(self.widths[1]):
            own = rows[terms.first_input + place]
            if len(np.unique(own)) < 3 or any(place == one for one, _ in form.thresholds):
                continue
            low, high = float(own.min()), float(own.max())
            for _ in range(3):
                grid = np.linspace(low, high, _GRID + 2)
                left = [_left(values, linear * (own > one), changes) for one in grid[1:-1]]
                least = int(np.argmin(left))
                best = min(best, (left[least], place, float(grid[least + 1])))
                low, high = float(grid[least]), float(grid[least + 2])
        return None if best[0] == np.inf else best[1:]

    def fitted(self, form: SurrogateForm, error: float, penalty: float) -> Surrogate:
        """The surrogate of a form, fitted to all trajectories."""
        terms, (weights,) = self._weights(form, self.all, [penalty])
        start = Start.of(self.trajectories.variables, self.trajectories.all())
        low, high = self.bounds(form)
        about = self.spec, self.trajectories.variables
        return Surrogate(terms, weights.T, low, high, start, error, *about)


def _left(values: FloatArray, more: FloatArray, changes: FloatArray) -> float:
    """Residuals of the changes, shape (n, k)."""
    both = np.concatenate([values, more])
    square = both @ both.T + 1e-6 * both.shape[1] * np.eye(len(both))
    weights = np.linalg.solve(square, both @ changes)
    return float(np.square(changes - both.T @ weights).mean())


def _pieces(trajectories: Sequence[EpisodeTrajectory], steps: int) -> Iterator[EpisodeTrajectory]:
    """Parts of trajectories of so many steps."""
    for starts, inputs, outputs in trajectories:
        for begin in range(0, len(inputs), steps):
            yield EpisodeTrajectory(
                starts, inputs[begin : begin + steps], outputs[begin : begin + steps + 1]
            )


def _simulation_errors(
    terms: Terms,
    weights: Sequence[FloatArray],
    trajectories: Sequence[EpisodeTrajectory],
    horizon: int,
    data: Any,
) -> FloatArray:
    """The root mean square error of outputs in simulations, for each set of weights.

    Simulations begin everywhere in the trajectories, and last so many steps. Errors count beside
    the spread of the output.
    """
    horizon = min(horizon, max(one.steps for one in trajectories))
    windows = [
        (
            regressors_of(terms.form, one)[:, begin : begin + horizon],
            one.outputs[begin + 1 :][:horizon],
        )
        for one in trajectories
        for begin in range(0, one.steps - horizon + 1, max(1, horizon // 2))
    ]
    rows = np.stack([rows for rows, _ in windows], axis=1)  # d, windows, steps
    true = np.stack([outputs for _, outputs in windows], axis=1)  # steps, windows, k
    outputs, count = data.widths[0], len(weights)
    errors = np.zeros((count, outputs))
    simulation = simulated(terms, weights, data.bounds(terms.form), rows)
    for after, right in zip(simulation, true, strict=True):
        wrong = (after - np.tile(right.T, count)) / data.spread[:, None]
        errors += np.square(wrong).reshape(outputs, count, -1).mean(axis=2).T
    return np.asarray(np.sqrt(errors.mean(axis=1) / horizon))


_PART: Final = 2
"""Errors are told for horizons up to this part of an episode."""

_UNITS: Final = ((2 * 86400.0, 86400.0, "d"), (2 * 3600.0, 3600.0, "h"), (0.0, 1.0, "s"))
"""From which length on a time is told in which unit."""


class Prediction(NamedTuple):
    """A surrogate beside the FMU.

    Attributes:
        trajectory: An episode of the FMU.
        outputs: Outputs that the surrogate predicts from its beginning on, shape (T + 1, k).
        errors: The root mean square error of predictions that begin everywhere in the episodes,
            by the number of their steps, shape (h, k).
        spread: The standard deviation of the outputs in the episodes, shape (k,).
    """

    trajectory: EpisodeTrajectory
    outputs: FloatArray
    errors: FloatArray
    spread: FloatArray


def predicted(surrogate: Surrogate, trajectories: Sequence[EpisodeTrajectory]) -> Prediction:
    """Predict episodes by a surrogate, from the FMU's inputs and first outputs.

    Args:
        surrogate: The surrogate.
        trajectories: Trajectories of the FMU, each with a step at least; the longest one is shown.
    """
    terms, bounds = surrogate.terms, (surrogate.low, surrogate.high)
    longest = max(trajectories, key=lambda one: one.steps)
    rows = regressors_of(terms.form, longest)[:, None]
    after = [*simulated(terms, [surrogate.weights.T], bounds, rows)]
    outputs = np.concatenate([longest.outputs[:1], np.array(after)[:, :, 0]])
    horizon = max(1, longest.steps // _PART)
    squares = [_squares(surrogate, one, horizon) for one in trajectories if one.steps >= horizon]
    errors = np.sqrt(np.concatenate(squares, axis=1).mean(axis=1))
    spread = np.concatenate([one.outputs for one in trajectories]).std(axis=0)
    return Prediction(longest, outputs, errors, spread)


def _squares(surrogate: Surrogate, trajectory: EpisodeTrajectory, horizon: int) -> FloatArray:
    """The squared errors of predictions from each step on, shape (horizon, n, k)."""
    begins = range(trajectory.steps - horizon + 1)
    rows = regressors_of(surrogate.terms.form, trajectory)
    windows = np.stack([rows[:, one : one + horizon] for one in begins], axis=1)
    true = np.stack([trajectory.outputs[one + 1 :][:horizon] for one in begins], axis=1)
    bounds = surrogate.low, surrogate.high
    after = np.array([*simulated(surrogate.terms, [surrogate.weights.T], bounds, windows)])
    return np.square(after.swapaxes(1, 2) - true)


def plot_prediction(prediction: Prediction, surrogate: Surrogate) -> Figure:
    """Draw an episode beside its prediction, and the errors by horizon.

    Returns:
        A figure of matplotlib, a row for each output. ``figure.savefig(path)`` saves it.
    """
    from fmugym.rendering.figures import Figure

    variables, time_step = surrogate.spec.outputs, surrogate.spec.time_step
    length = time_step * prediction.trajectory.steps
    _, scale, unit = next(one for one in _UNITS if length >= one[0])
    count = len(variables)
    figure = Figure(figsize=(9, 1 + 1.8 * count), layout="constrained")
    axes = figure.subplots(count, 2, sharex="col", squeeze=False, width_ratios=[2, 1])
    times = time_step / scale * np.arange(prediction.trajectory.steps + 1)
    horizons = times[1 : len(prediction.errors) + 1]
    for place, (variable, (trajectory, error)) in enumerate(zip(variables, axes, strict=True)):
        trajectory.plot(
            times, prediction.trajectory.outputs[:, place], color="0.6", lw=2.0, label="FMU"
        )
        trajectory.plot(
            times, prediction.outputs[:, place], color="#0072b2", lw=1.0, label="surrogate"
        )
        trajectory.set_ylabel(
            f"{variable.name} [{variable.unit}]" if variable.unit else variable.name
        )
        error.plot(
            horizons, prediction.errors[:, place], color="#0072b2", label="error of the surrogate"
        )
        error.axhline(prediction.spread[place], color="0.6", ls="--", label="spread of the output")
        error.set_ylim(bottom=0.0)
        for one in (trajectory, error):
            one.grid(alpha=0.3)
    axes[0][0].set_title("an episode that the fit has not seen")
    axes[0][1].set_title("root mean square error")
    axes[-1][0].set_xlabel(f"time [{unit}]")
    axes[-1][1].set_xlabel(f"predicted this long [{unit}]")
    lines = [*axes[0][0].lines, *axes[0][1].lines]
    figure.legend(handles=lines, loc="outside lower center", ncols=len(lines))
    return figure
