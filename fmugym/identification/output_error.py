"""Output-error fitting: find values for which an FMU's simulation follows the measurement.

The method is maximum likelihood if the measured outputs have independent normal noise of the given
relative sizes; see Ljung, "System Identification" (1999), chapter 7. To fit a chaotic plant, use
many short trajectories with their own initial states (multiple shooting) instead of a long one.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fmugym.archive.fmu import FMU, StandsForFMU
from fmugym.checks import check_flag, check_integer, check_mapping, check_number, check_text
from fmugym.distributions import Normal
from fmugym.errors import ConfigError
from fmugym.identification.comparison import Comparison
from fmugym.identification.problem import Experiment, Limits, Problem
from fmugym.identification.statistics import Estimate, normal_distributions
from fmugym.identification.trajectory import Trajectory, common_names

__all__ = ["FitResult", "fit_parameters"]


@dataclass(frozen=True, eq=False)
class FitResult(Estimate):
    """The result of ``fit_parameters``; the values are in the form of ``model_parameters``.

    Attributes:
        bounds: Lower and upper bound of each value by name.
        comparison: The fitted trajectories and their simulation.
        converged: Whether the optimization converged within its limit of evaluations.
        message: Why the optimization ended.
    """

    bounds: dict[str, tuple[float, float]]
    comparison: Comparison
    converged: bool
    message: str
    experiment: Experiment
    """The settings, which predictions need."""

    def distributions(self) -> dict[str, Normal]:
        """Return each value as a normal distribution, truncated at its bounds.

        The standard deviation is the standard error. Correlations between the values are lost.

        Raises:
            ConfigError: If the data do not determine a value.
        """
        return normal_distributions(self.values, self.standard_errors, self.bounds)

    def rms(self, output: str) -> float:
        """Return the RMS of the residuals of the fit, in the unit of the output."""
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
            refit_initial_states: Whether to fit the initial state of each trajectory to its
                samples. Otherwise the first sample gives the initial state.
            lead_in: How many seconds of samples the refit uses. The rest is then a prediction in
                the strict sense. None for all samples.

        Returns:
            Measured and simulated outputs.

        Raises:
            ConfigError: If an argument has a wrong type or range.
            SimulationError: If the FMU fails.
        """
        refit_initial_states = check_flag("refit_initial_states", refit_initial_states)
        if lead_in is not None:
            lead_in = check_number("lead_in", lead_in, positive=True, may_be_infinite=True)
        common_names(trajectories)
        experiment, shifted = self._for_prediction(trajectories)
        if lead_in is None or not refit_initial_states:
            return _simulate(experiment, shifted, refit_initial_states)
        heads = [t.between(t.time[0], t.time[0] + lead_in) for t in shifted]
        states = _simulate(experiment, heads, True).initial_values
        return _simulate(experiment, shifted, False, states)

    def _for_prediction(
        self, trajectories: Sequence[Trajectory]
    ) -> tuple[Experiment, list[Trajectory]]:
        """Fix the fitted values, and add fitted constants to the logged inputs."""
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
    """Simulate with fixed parameters from refitted, measured or given initial states."""
    with closing(Problem(experiment, {}, trajectories, refit)) as problem:
        return problem.compare(problem.start, states)


def fit_parameters(
    fmu: FMU | StandsForFMU | str | os.PathLike[str],
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
            that measures the state, or a number. None if the FMU's own start values are right.
        fit_initial_states: Whether to fit the initial states of each trajectory too. Otherwise the
            first samples give them.
        fixed: Values of other parameters by name.
        scales: Standard deviation of the noise of each output, in its unit. Only the ratios
            matter. None for the standard deviation of each output.
        time_step: Communication step size in seconds; None for the median sampling interval.
        clustered: Whether the residuals of a trajectory may be correlated, as they are if the
            model is not exact. This needs more trajectories than parameters. Otherwise all
            residuals count as independent, and correlation makes the standard errors too small.
            See Cameron and Miller, "A Practitioner's Guide to Cluster-Robust Inference", Journal
            of Human Resources 50 (2015).
        drop_repeats: Whether to drop stale samples first; see ``Trajectory.without_repeats``.
        max_evaluations: Largest number of evaluations of the optimization.
        backend: See ``fmugym.pool.wishes.Wishes``.

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
    experiment = Experiment(
        FMU.of(fmu),
        _mapping("initial_states", initial_states),
        _mapping("fixed", fixed),
        _mapping("scales", scales),
        time_step,
        check_flag("drop_repeats", drop_repeats),
        check_text("backend", backend),
    )
    clustered = check_flag("clustered", clustered)
    max_evaluations = check_integer("max_evaluations", max_evaluations, 1, 10**9)
    fit_states = check_flag("fit_initial_states", fit_initial_states)
    with closing(Problem(experiment, wanted, trajectories, fit_states)) as problem:
        return _result(experiment, problem, problem.solve(max_evaluations), clustered)


def _mapping(what: str, value: Any) -> dict[Any, Any]:
    return {} if value is None else check_mapping(what, value)


def _result(experiment: Experiment, problem: Problem, solution: Any, clustered: bool) -> FitResult:
    """Collect the results of the optimization."""
    covariance, freedom = problem.covariance(solution, clustered)
    return FitResult(
        values=dict(zip(problem.bounds, solution.x.tolist(), strict=True)),
        covariance=covariance,
        bounds=problem.bounds,
        degrees_of_freedom=freedom,
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
