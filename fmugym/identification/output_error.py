"""Output-error fitting: the values under which an FMU's simulation follows the measurement.

The method is maximum likelihood where the measured outputs have independent normal noise of the
given relative sizes; see Ljung, "System Identification" (1999), chapter 7. Many short trajectories
with initial states of their own (multiple shooting) fit what a long one cannot: a chaotic plant.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fmugym.archive.fmu import FMU
from fmugym.distributions import Normal
from fmugym.errors import ConfigError
from fmugym.identification.problem import Experiment, Limits, Problem
from fmugym.identification.results import Comparison
from fmugym.identification.statistics import confidence_intervals, normal_distributions
from fmugym.identification.trajectory import Trajectory
from fmugym.pool.base import FloatArray

__all__ = ["FitResult", "fit_parameters"]


@dataclass(frozen=True, eq=False)
class FitResult:
    """What ``fit_parameters`` found.

    Attributes:
        values: The fitted values by name, to be passed on as ``model_parameters``.
        standard_errors: By name, in the units of the values; infinite where the data do not
            determine a value.
        covariance: Of the values, in their order, shape (k, k).
        bounds: Lower and upper bound of each value by name.
        degrees_of_freedom: For the confidence intervals.
        comparison: The fitted trajectories and their simulation.
        converged: Whether the optimization ended by itself, not by its limit of evaluations.
        message: How the optimization ended.
    """

    values: dict[str, float]
    standard_errors: dict[str, float]
    covariance: FloatArray
    bounds: dict[str, tuple[float, float]]
    degrees_of_freedom: int
    comparison: Comparison
    converged: bool
    message: str
    experiment: Experiment
    """For predictions."""

    def confidence_intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return lower and upper end by name; they may exceed the bounds."""
        return confidence_intervals(
            self.values, self.standard_errors, self.degrees_of_freedom, level
        )

    def distributions(self) -> dict[str, Normal]:
        """Give each value as a normal distribution, truncated at its bounds.

        Its standard deviation is the standard error. Correlations between the values are lost.

        Raises:
            ConfigError: If the data did not determine a value.
        """
        return normal_distributions(self.values, self.standard_errors, self.bounds)

    def rms(self, output: str) -> float:
        """Return the RMS of the fitted trajectories' residuals, in the unit of the output."""
        return self.comparison.rms(output)

    def predict(
        self,
        trajectories: Sequence[Trajectory],
        *,
        refit_initial_states: bool = True,
        lead_in: float | None = None,
    ) -> Comparison:
        """Simulate other trajectories with the fitted values.

        Args:
            trajectories: Held-out measurements, with the same outputs and inputs.
            refit_initial_states: Fit the initial state of each one to its samples; otherwise it is
                what the first sample says.
            lead_in: Refit to the samples of the first so many seconds only: what follows is
                predicted in the strict sense. None for all samples.

        Returns:
            Measured and simulated outputs.
        """
        experiment, shifted = self._for_prediction(trajectories)
        if lead_in is None or not refit_initial_states:
            return _simulate(experiment, shifted, refit_initial_states)
        heads = [t.between(t.time[0], t.time[0] + lead_in) for t in shifted]
        states = _simulate(experiment, heads, True).initial_values
        return _simulate(experiment, shifted, False, states)

    def _for_prediction(
        self, trajectories: Sequence[Trajectory]
    ) -> tuple[Experiment, list[Trajectory]]:
        """Fix the fitted values, and add those of inputs to what was logged."""
        description = self.experiment.fmu.description
        offsets = {n for n in self.values if description.variable(n).causality == "input"}
        fixed = {n: v for n, v in self.values.items() if n not in offsets}
        experiment = replace(self.experiment, fixed={**self.experiment.fixed, **fixed})
        return experiment, [_shifted(t, {n: self.values[n] for n in offsets}) for t in trajectories]


def _simulate(
    experiment: Experiment,
    trajectories: Sequence[Trajectory],
    refit: bool,
    states: Sequence[Mapping[str, float]] | None = None,
) -> Comparison:
    """Simulate without fitting parameters, from refitted, measured or given initial states."""
    with closing(Problem(experiment, {}, trajectories, refit)) as problem:
        return problem.compare(problem.start, states)


def fit_parameters(
    fmu: FMU | str | os.PathLike[str],
    parameters: Mapping[str, Limits],
    trajectories: Sequence[Trajectory],
    *,
    initial_states: Mapping[str, str | float] | None = None,
    fit_initial_states: bool = True,
    fixed: Mapping[str, float | str] | None = None,
    scales: Mapping[str, float] | None = None,
    time_step: float | None = None,
    clustered: bool = False,
    drop_repeats: bool = True,
    max_evaluations: int = 100,
    backend: str = "auto",
) -> FitResult:
    """Fit parameters of an FMU to logged trajectories.

    Minimized is the sum of the squared differences between simulated and measured outputs, each
    divided by its scale. The simulations for all trajectories and all finite differences of a
    Jacobian run at once, an instance of one pool each.

    Args:
        fmu: Its path; or an ``FMU``, whose ``limits``, ``preload`` and ``probe_timeout`` hold.
        parameters: What to fit, by the name of the FMU's variable: a number to start from; or
            bounds ``(low, high)``; or ``(start, low, high)``. Missing bounds are the variable's
            min and max, a missing start is its own start value or the middle. The name of an
            input stands for a constant that is added to it.
        trajectories: The measurements. Simulated time begins at 0 with each.
        initial_states: The FMU's start parameters of the states, each with the name of the output
            that measures it, or with a number. None where every trajectory starts as the FMU does.
        fit_initial_states: Fit the start parameters of each trajectory too; otherwise its first
            sample is trusted.
        fixed: Values of other parameters by name.
        scales: The noise's standard deviation of each output, in its unit; only their ratios
            count. None for every output's own standard deviation.
        time_step: Communication step size in seconds; None for the median sampling interval.
        clustered: Take the residuals of a trajectory for correlated, as they are where the model
            is not exact, and only trajectories for independent; needs more of these than there
            are parameters. Otherwise all residuals count as independent, and standard errors are
            too small where they are not. See Cameron and Miller, "A Practitioner's Guide to
            Cluster-Robust Inference", Journal of Human Resources 50 (2015).
        drop_repeats: Leave out stale samples first; see ``Trajectory.without_repeats``.
        max_evaluations: Limit of the optimization's steps.
        backend: See ``fmugym.trial.opening.make_pool``.

    Returns:
        Values, standard errors, and the comparison of measurement and simulation.

    Raises:
        ConfigError: If a name, a bound or a trajectory does not fit.
        SimulationError: If the FMU fails at the start or next to a point of the way.
        ImportError: If SciPy is not there.
    """
    if not parameters:
        raise ConfigError("there is no parameter to be fitted")
    experiment = Experiment(
        FMU.of(fmu),
        initial_states or {},
        fixed or {},
        scales or {},
        time_step,
        drop_repeats,
        backend,
    )
    with closing(Problem(experiment, parameters, trajectories, fit_initial_states)) as problem:
        return _result(experiment, problem, problem.solve(max_evaluations), clustered)


def _result(experiment: Experiment, problem: Problem, solution: Any, clustered: bool) -> FitResult:
    """Put together what the optimization left."""
    covariance, freedom = problem.covariance(solution, clustered)
    names = list(problem.bounds)
    return FitResult(
        values=dict(zip(names, solution.x.tolist(), strict=True)),
        standard_errors=dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        covariance=covariance,
        bounds=problem.bounds,
        degrees_of_freedom=freedom,
        comparison=problem.compare(solution.x),
        converged=solution.status > 0,
        message=solution.message,
        experiment=experiment,
    )


def _shifted(trajectory: Trajectory, offsets: Mapping[str, float]) -> Trajectory:
    """Add fitted constants to the inputs."""
    nothing = np.zeros(len(trajectory))
    shifted = {n: trajectory.inputs.get(n, nothing) + value for n, value in offsets.items()}
    return replace(trajectory, inputs={**trajectory.inputs, **shifted})
