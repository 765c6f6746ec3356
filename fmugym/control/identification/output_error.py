"""Output-error fitting: find values for which an FMU's simulation follows the measurement.

The method is maximum likelihood if the measured outputs have independent normal noise of the given
relative sizes; see Ljung, "System Identification" (1999), chapter 7. To fit a chaotic plant, use
many short trajectories with their own initial states (multiple shooting) instead of a long one.
Residuals that are correlated make the standard errors larger; the model is then not exact, and no
standard error tells what that does to the values.

A shift between the clocks of inputs and outputs looks like a wrong model; it is fitted, too.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.checks import (
    by_own_names,
    check_integer,
    check_mapping,
    check_number,
    check_seed,
)
from fmugym.control.identification.least_squares import Correlation, ParameterLimits, Problem
from fmugym.control.identification.simulator import FitSettings
from fmugym.control.identification.trajectory import Comparison, Trajectory, named_as_own
from fmugym.environment.distributions import DrawnColumn
from fmugym.errors import ConfigError, SimulationError
from fmugym.extras import imported
from fmugym.fmi.fmu import FMU, StandsForFMU
from fmugym.pool.pool import FloatArray

__all__ = ["FitResult", "Shift", "fit_of", "fit_parameters", "shift_of_clocks"]

_GUESS = 12.0
"""One over the variance of a uniform distribution, in units of its range."""

_MATTERS = 0.3
"""Parts of a direction, which has the length 1, that are worth naming."""


@dataclass(frozen=True, eq=False)
class FitResult:
    """The result of ``fit_parameters``; the values are in the form of ``model_parameters``.

    Attributes:
        values: The values by name.
        covariance: Covariance of the values, in their order, shape (k, k).
        information: The inverse of the covariance, which is 0 along directions of which the data
            tell nothing, shape (k, k).
        correlations: How the residuals depend on those before, by output.
        degrees_of_freedom: Degrees of freedom of the confidence intervals.
        costs: What each start of the optimization has come to, half the sum of the squared
            residuals in units of their scales; the best is the first.
        bounds: Lower and upper bound of each value by name.
        comparison: The fitted trajectories and their simulation.
        converged: Whether the optimization converged within its limit of evaluations.
        message: Why the optimization ended.
    """

    values: dict[str, float]
    covariance: FloatArray
    information: FloatArray
    degrees_of_freedom: int
    correlations: dict[str, Correlation]
    costs: tuple[float, ...]
    bounds: dict[str, tuple[float, float]]
    comparison: Comparison
    converged: bool
    message: str
    experiment: FitSettings
    """The settings, which predictions need."""

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name; infinite for a value that the data do not determine."""
        return dict(zip(self.values, self._errors.tolist(), strict=True))

    @property
    def correlation_matrix(self) -> FloatArray:
        """Correlations of the values, in their order, shape (k, k); 0 for undetermined ones."""
        errors = self._errors
        known = np.where(np.isfinite(errors) & (errors > 0.0), errors, np.inf)
        scaled = np.where(np.isfinite(self.covariance), self.covariance, 0.0)
        return np.asarray(scaled / np.outer(known, known))

    def factor(self, level: float) -> float:
        """Half the width of an interval in standard errors, by Student's t distribution.

        Args:
            level: Probability that an interval covers the true value, between 0 and 1.

        Raises:
            ConfigError: If the level is not between 0 and 1.
        """
        level = check_number("level", level, positive=True)
        if level >= 1.0:
            raise ConfigError(f"level must be less than 1, not {level:g}")
        freedom = self.degrees_of_freedom
        student = imported("scipy.stats", "identification").t
        return float(student.ppf(0.5 + level / 2, freedom))

    def confidence_intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return lower and upper end by name; they may exceed the bounds.

        Raises:
            ConfigError: If the level is not between 0 and 1.
        """
        factor, errors = self.factor(level), self.standard_errors
        return {n: (v - factor * errors[n], v + factor * errors[n]) for n, v in self.values.items()}

    def distributions(self) -> dict[str, DrawnColumn]:
        """Return the parameters as distributions; each episode draws one of 1000 ``rows``."""
        columns = zip(self.values, self.rows(1000).T.tolist(), strict=True)
        return {name: DrawnColumn(values, table="fit") for name, values in columns}

    def untold(self) -> list[dict[str, float]]:
        """Name combinations of parameters that the data hardly determine.

        Along such a direction the standard error is larger than that of a guess within the bounds.

        Returns:
            For each direction, how far each parameter goes along it as a part of its range, those
            that matter by name; the least determined direction is the first.
        """
        widths = self._widths()
        scales = np.where(np.isfinite(widths), widths, np.abs([*self.values.values()]))
        told, directions = np.linalg.eigh(self.information * np.outer(scales, scales))
        return [
            {n: float(x) for n, x in zip(self.values, along, strict=True) if abs(x) > _MATTERS}
            for amount, along in zip(told, directions.T, strict=True)
            if amount < _GUESS
        ]

    def rows(self, count: int, seed: int | None = 0) -> FloatArray:
        """Draw values that fit the data together, from the normal distribution within the bounds.

        What the data do not tell varies over the whole range.

        Args:
            count: How many.
            seed: Seed of the draws.

        Returns:
            A row for each draw, in the order of ``values``, shape (count, k).

        Raises:
            ConfigError: If the data do not determine a value that has no bounds, or the count or
                the seed is no such number.
        """
        count, seed = check_integer("count", count, 1, 10**6), check_seed(seed)
        widths, center = self._widths(), np.array([*self.values.values()])
        bounded = np.isfinite(widths)
        scales = np.where(bounded, widths, self._errors)
        for name, scale in zip(self.values, scales, strict=True):
            if not np.isfinite(scale):
                raise ConfigError(f"{name!r} has no distribution: give it bounds")
        told = self.information * np.outer(scales, scales) + np.diag(np.where(bounded, _GUESS, 0.0))
        amounts, directions = np.linalg.eigh(told)
        root = directions / np.sqrt(amounts)
        low, high = np.array([*self.bounds.values()]).T
        rng, kept = np.random.default_rng(seed), np.empty((0, len(center)))
        while len(kept) < count:
            drawn = center + rng.standard_normal((count, len(center))) @ root.T * scales
            kept = np.vstack([kept, drawn[((low <= drawn) & (drawn <= high)).all(axis=1)]])
        return kept[:count]

    @property
    def _errors(self) -> FloatArray:
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def _widths(self) -> FloatArray:
        return np.array([high - low for low, high in self.bounds.values()])

    def rms(self, output: str) -> float:
        """Return the RMS of the residuals of the fit, in the unit of the output."""
        return self.comparison.rms(output)

    def predict(
        self,
        trajectories: Sequence[Trajectory],
    ) -> Comparison:
        """Simulate other trajectories with the fitted values, and fit their initial states.

        Args:
            trajectories: Held-out measurements, with the same outputs and inputs.

        Returns:
            Measured and simulated outputs.

        Raises:
            ConfigError: If an argument has a wrong type or range.
            SimulationError: If the FMU fails.
        """
        experiment, shifted = self._for_prediction(trajectories)
        with closing(Problem(experiment, {}, shifted)) as problem:
            return problem.compare(problem.start)

    def _for_prediction(
        self, trajectories: Sequence[Trajectory]
    ) -> tuple[FitSettings, list[Trajectory]]:
        """Fix the fitted values, and add fitted constants to the logged inputs."""
        fmu = self.experiment.fmu
        trajectories = named_as_own(trajectories, _own_name_in(fmu))
        offsets = {n for n in self.values if fmu.variable(n).causality == "input"}
        fixed = {n: v for n, v in self.values.items() if n not in offsets}
        experiment = replace(self.experiment, fixed={**self.experiment.fixed, **fixed})
        return experiment, [_shifted(t, {n: self.values[n] for n in offsets}) for t in trajectories]


def fit_parameters(
    fmu: FMU | StandsForFMU | str | os.PathLike[str],
    parameters: Mapping[str, ParameterLimits],
    trajectories: Sequence[Trajectory],
    *,
    initial_states: Mapping[str, str | float] | None = None,
    fixed: Mapping[str, float | str] | None = None,
    scales: Mapping[str, float] | None = None,
    time_step: float | None = None,
    wash_in: float | None = None,
    candidates: int = 1,
) -> FitResult:
    """Fit parameters of an FMU to logged trajectories.

    The fit minimizes the sum of the squared differences between simulated and measured outputs,
    each divided by its scale. The simulations for all trajectories and all finite differences of a
    Jacobian run at once, each in its own instance of one pool.

    Args:
        fmu: The path of the FMU, an ``FMUSystem``, or an ``FMU`` with its own ``limits``,
            ``preload`` and ``probe_timeout``.
        parameters: The variables to fit by name, each with a start value, with bounds
            ``(low, high)``, or with ``(start, low, high)``. Missing bounds are the variable's min
            and max. A missing start is the variable's start value, or the middle of the bounds.
            The name of an input stands for a constant that is added to the input.
        trajectories: The measurements. Simulated time begins at 0 in each of them.
        initial_states: The FMU's start parameters of the states. Each has the name of the output
            that measures the state, or a number, where its fit begins. None if the FMU's own start
            values are right.
        fixed: Values of other parameters by name.
        scales: Standard deviation of the noise of each output, in its unit. Only the ratios
            matter. Without it, an output is weighted by the noise that its residuals show, at
            first by its standard deviation.
        time_step: Communication step size in seconds; None for the median sampling interval.
        wash_in: How many seconds of each trajectory are simulated but not counted, so that the
            initial state is forgotten; 0 leaves out the first sample. None counts all.
        candidates: How many points within the bounds, the start among them, are tried at once. The
            fit begins at the three best ones.

    Returns:
        Values, standard errors, and the comparison of measurement and simulation.

    Raises:
        ConfigError: If an argument has a wrong type or range, or does not fit the FMU.
        FMULoadError: If the FMU cannot be opened.
        SimulationError: If the FMU fails with the start values or near a tried point.
        ImportError: If SciPy is not installed.
    """
    wanted = check_mapping("parameters", parameters)
    if not wanted:
        raise ConfigError("there is no parameter to fit")
    opened = FMU.of(fmu)
    own_name = _own_name_in(opened)
    experiment = FitSettings(
        opened,
        by_own_names("initial_states", _mapping("initial_states", initial_states), own_name),
        by_own_names("fixed", _mapping("fixed", fixed), own_name),
        _mapping("scales", scales),
        time_step,
        drop_repeats=True,
        wash_in=wash_in,
    )
    wanted = by_own_names("parameters", wanted, own_name)
    return fit_of(experiment, wanted, named_as_own(trajectories, own_name), candidates)


def _mapping(what: str, value: Any) -> dict[Any, Any]:
    return {} if value is None else check_mapping(what, value)


def _own_name_in(fmu: FMU) -> Callable[[str], str]:
    """A function that finds the own name of a variable, also by letters that look the same."""
    return lambda name: fmu.variable(name).name


def fit_of(
    experiment: FitSettings,
    parameters: Mapping[str, ParameterLimits],
    trajectories: Sequence[Trajectory],
    candidates: int,
) -> FitResult:
    """Fit with these settings; see ``fit_parameters``."""
    candidates = check_integer("candidates", candidates, 1, 10**6)
    with closing(Problem(experiment, parameters, trajectories)) as problem:
        solution, costs = problem.solve(candidates)
        return FitResult(
            values=dict(zip(problem.bounds, solution.x.tolist(), strict=True)),
            **problem.uncertainty(solution),
            costs=tuple(costs),
            bounds=problem.bounds,
            comparison=problem.compare(solution.x),
            converged=solution.status > 0,
            message=solution.message,
            experiment=experiment,
        )


def _shifted(trajectory: Trajectory, offsets: Mapping[str, float]) -> Trajectory:
    """Add fitted constants to the logged inputs."""
    nothing = np.zeros(len(trajectory))
    shifted = {n: trajectory.inputs.get(n, nothing) + value for n, value in offsets.items()}
    return replace(trajectory, inputs={**trajectory.inputs, **shifted})


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
