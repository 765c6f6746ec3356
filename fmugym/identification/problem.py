"""The least-squares problem behind an output-error fit.

Variable projection eliminates the initial states of the trajectories. For given parameters, the fit
of each trajectory finds its best initial state. The Jacobian of the parameters then loses its part
in the directions of these states (Kaufman's form; see Golub and Pereyra, "Separable nonlinear least
squares", Inverse Problems 19, 2003). The size of the optimization therefore does not depend on the
number of trajectories.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.archive.fmu import FMU
from fmugym.archive.variable import Variable
from fmugym.checks import check_number, check_text, float_or_nan
from fmugym.errors import ConfigError, SimulationError, shown, unknown_name
from fmugym.extras import imported
from fmugym.identification.comparison import Comparison
from fmugym.identification.simulator import Simulator
from fmugym.identification.statistics import information_inverse
from fmugym.identification.trajectory import Trajectory, common_names
from fmugym.pool.base import FloatArray

__all__ = ["Experiment", "Limits", "Problem"]

Limits = float | tuple[float, float] | tuple[float, float, float]

DIFFERENCE = 1e-6
"""Step of the finite differences, as a fraction of a value's typical size."""

FAILED = 1e3
"""Residual of a failed simulation, in units of the scale; it keeps the optimizer away."""

MAX_ITERATIONS = 50
"""Largest number of iterations in the fit of the initial states."""


@dataclass(frozen=True)
class Experiment:
    """The common settings of a fit and its predictions; see ``fit_parameters``."""

    fmu: FMU
    initial_states: Mapping[str, str | float]
    fixed: Mapping[str, float | str]
    scales: Mapping[str, float]
    time_step: float | None
    drop_repeats: bool
    backend: str

    def clean(self, trajectories: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
        """Check the trajectories, and drop stale samples if requested."""
        common_names(trajectories)
        return tuple(t.without_repeats() if self.drop_repeats else t for t in trajectories)


@dataclass(frozen=True, eq=False)
class _Block:
    """One trajectory's part of the problem at one point.

    Attributes:
        residual: The residuals, shape (m,); NaN after a failed simulation.
        slopes: Their derivatives with respect to parameters or states, shape (m, k).
    """

    residual: FloatArray
    slopes: FloatArray

    @property
    def cost(self) -> float:
        """Sum of the squared residuals."""
        return float(self.residual @ self.residual)

    def step(self, damping: float) -> FloatArray:
        """Compute the Levenberg-Marquardt step, shape (k,); zeros after a failure."""
        matrix = self.slopes.T @ self.slopes
        matrix += damping * np.diag(np.diag(matrix))
        gradient = self.slopes.T @ self.residual
        if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
            return np.zeros(len(gradient))
        return np.asarray(-np.linalg.lstsq(matrix, gradient, rcond=None)[0], np.float64)

    def is_solved(self, step: FloatArray) -> bool:
        """Whether a step promises a negligible gain."""
        gain = -step @ self.slopes.T @ self.residual
        return not gain > 1e-10 * self.cost + 1e-20 * len(self.residual)

    def project(self, count: int) -> FloatArray:
        """Return the first slopes without the part that the others explain; shape (m, count)."""
        wanted, others = self.slopes[:, :count], self.slopes[:, count:]
        projected: FloatArray = wanted - others @ np.linalg.lstsq(others, wanted, rcond=None)[0]
        return projected


class Problem:
    """The residuals, their Jacobian, and the covariance at a solution.

    Args:
        experiment: The settings.
        parameters: The parameters to fit; see ``fit_parameters``.
        trajectories: The measured trajectories.
        fit_states: Whether to fit the initial states.

    Attributes:
        trajectories: The trajectories without stale samples.
        bounds: Lower and upper bound of each parameter by name.
        start: The start values of the parameters, shape (k,).
    """

    def __init__(
        self,
        experiment: Experiment,
        parameters: Mapping[str, Limits],
        trajectories: Sequence[Trajectory],
        fit_states: bool = True,
    ) -> None:
        self.trajectories = experiment.clean(trajectories)
        self._state_names = list(experiment.initial_states)
        self._states = _measured_states(experiment.initial_states, self.trajectories)
        names = [*parameters, *self._state_names]
        self._rows = range(len(names) if fit_states else len(parameters))
        self._simulator = Simulator(
            experiment.fmu,
            self.trajectories,
            names,
            experiment.fixed,
            1 + len(self._rows),
            experiment.time_step,
            experiment.backend,
        )
        try:
            self._set_limits([self._simulator.description.variable(n) for n in names], parameters)
            self._scales = _scales(experiment.scales, self.trajectories, self._simulator.outputs)
        except BaseException:
            self.close()
            raise
        self._last = np.empty(0), self._states

    def _set_limits(self, variables: Sequence[Variable], parameters: Mapping[str, Limits]) -> None:
        fitted, states = variables[: len(parameters)], variables[len(parameters) :]
        limits = [_limits(v, parameters[v.name]) for v in fitted]
        self.bounds = {v.name: x[1:] for v, x in zip(fitted, limits, strict=True)}
        self.start = np.array([x[0] for x in limits])
        self._high = np.array([x[2] for x in limits] + [v.maximum for v in states])
        self._low = np.array([x[1] for x in limits] + [v.minimum for v in states])
        sizes = [max(abs(x[0]), v.nominal or 0.0) for v, x in zip(fitted, limits, strict=True)]
        sizes += [v.nominal or 0.0 for v in states]
        self._differences = DIFFERENCE * np.array([size or 1.0 for size in sizes])

    def close(self) -> None:
        """Free the simulator."""
        self._simulator.close()

    def solve(self, max_evaluations: int) -> Any:
        """Minimize the residuals, and return SciPy's result."""
        self.compare(self.start, refit=False)  # fails early with the FMU's reason
        count = len(self.start)
        return imported("scipy.optimize", "identification").least_squares(
            self._residuals,
            self.start,
            jac=self._jacobian,
            bounds=(self._low[:count], self._high[:count]),
            x_scale="jac",
            max_nfev=max_evaluations,
        )

    def compare(
        self,
        parameters: FloatArray,
        states: Sequence[Mapping[str, float]] | None = None,
        *,
        refit: bool = True,
    ) -> Comparison:
        """Simulate all trajectories.

        Args:
            parameters: Their values, shape (k,).
            states: Given initial states of each trajectory, or None.
            refit: Whether to fit the initial states, if the problem fits them.
        """
        values = self._states
        if states is not None:
            values = np.reshape([list(state.values()) for state in states], (len(states), -1)).T
        elif refit:
            values = self._fit_states(parameters)[0]
        simulated = self._simulator.simulate(self._join(parameters, values))
        if not all(np.isfinite(outputs).all() for outputs in simulated):
            raise SimulationError(f"the simulation failed: {self._simulator.failure}")
        names = self._simulator.outputs
        return Comparison(
            self.trajectories,
            tuple(dict(zip(names, outputs[0].T, strict=True)) for outputs in simulated),
            tuple(dict(zip(self._state_names, s, strict=True)) for s in values.T.tolist()),
        )

    def covariance(self, solution: Any, clustered: bool) -> tuple[FloatArray, int]:
        """Estimate the covariance of the parameters; returns it with its degrees of freedom."""
        inverse, undetermined = information_inverse(solution.jac)
        num_states = (len(self._rows) - len(self.start)) * len(self.trajectories)
        freedom = max(1, len(solution.fun) - len(self.start) - num_states)
        covariance = inverse * (solution.fun @ solution.fun) / freedom
        if clustered:
            freedom = self._require_clusters()
            scores = np.stack([jacobian.T @ r for jacobian, r in self._by_trajectory(solution)])
            factor = len(self.trajectories) / freedom
            covariance = inverse @ scores.T @ scores @ inverse * factor
        unknown = np.flatnonzero(undetermined)
        covariance[unknown, unknown] = np.inf
        return covariance, freedom

    def _require_clusters(self) -> int:
        freedom = len(self.trajectories) - len(self.start)
        if freedom < 1:
            raise ConfigError(
                "clustered standard errors need more trajectories than parameters: "
                f"{len(self.trajectories)} trajectories, {len(self.start)} parameters"
            )
        return freedom

    def _by_trajectory(self, solution: Any) -> list[tuple[FloatArray, FloatArray]]:
        ends = np.cumsum([len(t) * len(self._simulator.outputs) for t in self.trajectories])[:-1]
        return list(zip(np.split(solution.jac, ends), np.split(solution.fun, ends), strict=True))

    def _residuals(self, parameters: FloatArray) -> FloatArray:
        """Return what SciPy minimizes: the residuals at the best initial states."""
        states, blocks = self._fit_states(parameters)
        self._last = parameters.copy(), states
        residuals = np.concatenate([block.residual for block in blocks])
        return np.where(np.isfinite(residuals), residuals, FAILED)

    def _jacobian(self, parameters: FloatArray) -> FloatArray:
        """Return the derivative of the residuals, at a point that SciPy has accepted."""
        if not np.array_equal(parameters, self._last[0]):
            self._residuals(parameters)
        self._states = self._last[1]
        blocks = self._evaluate(parameters, self._states, self._rows)
        if not all(np.isfinite(block.slopes).all() for block in blocks):
            raise SimulationError(
                f"a simulation with slightly other values failed: {self._simulator.failure}"
            )
        return np.concatenate([block.project(len(parameters)) for block in blocks])

    def _fit_states(self, parameters: FloatArray) -> tuple[FloatArray, list[_Block]]:
        """Return the best initial states, shape (states, W), and the blocks there."""
        count = len(parameters)
        rows = self._rows[count:]

        def evaluate(states: FloatArray) -> list[_Block]:
            return self._evaluate(parameters, states, rows)

        limits = self._low[count:, np.newaxis], self._high[count:, np.newaxis]
        if not rows:
            return self._states, evaluate(self._states)
        return _levenberg_marquardt(evaluate, self._states, limits)

    def _evaluate(
        self, parameters: FloatArray, states: FloatArray, rows: Sequence[int]
    ) -> list[_Block]:
        """Simulate, and differentiate with respect to the parameters and states of some rows."""
        base = self._join(parameters, states)
        signs = np.where(
            base[:, 0] + self._differences[:, np.newaxis] > self._high[:, np.newaxis], -1, 1
        )
        steps = signs * self._differences[:, np.newaxis]
        values = np.repeat(base, 1 + len(rows), axis=1)
        for index, row in enumerate(rows):
            values[row, 1 + index] += steps[row]
        errors = [self._errors(s, w) for w, s in enumerate(self._simulator.simulate(values))]
        return [_Block(e[0], (e[1:] - e[0]).T / steps[list(rows), w]) for w, e in enumerate(errors)]

    def _join(self, parameters: FloatArray, states: FloatArray) -> FloatArray:
        """Return the values for one simulation of each trajectory, shape (names, 1, W)."""
        shared = np.tile(parameters[:, np.newaxis], len(self.trajectories))
        return np.concatenate([shared, states])[:, np.newaxis]

    def _errors(self, simulated: FloatArray, index: int) -> FloatArray:
        """Return one trajectory's scaled residuals, shape (sets, n * outputs)."""
        outputs = self.trajectories[index].outputs
        measured = np.stack([outputs[name] for name in self._simulator.outputs], axis=1)
        scaled: FloatArray = (simulated - measured) / self._scales
        return scaled.reshape(len(scaled), -1)


def _levenberg_marquardt(
    evaluate: Callable[[FloatArray], list[_Block]],
    states: FloatArray,
    limits: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, list[_Block]]:
    """Fit the initial state of every trajectory, each with its own damping.

    Args:
        evaluate: Returns the block of each trajectory at given states.
        states: Start values, shape (states, W).
        limits: Lowest and highest states, shape (states, 1).

    Returns:
        The states, shape (states, W), and the blocks there.
    """
    damping = np.full(states.shape[1], 1e-4)
    blocks = evaluate(states)
    for _ in range(MAX_ITERATIONS):
        steps = [block.step(factor) for block, factor in zip(blocks, damping, strict=True)]
        if all(block.is_solved(step) for block, step in zip(blocks, steps, strict=True)):
            break
        trial = np.clip(states + np.stack(steps, axis=1), *limits)
        tried = evaluate(trial)
        better = np.array([new.cost < old.cost for new, old in zip(tried, blocks, strict=True)])
        states = np.where(better, trial, states)
        blocks = [tried[w] if better[w] else block for w, block in enumerate(blocks)]
        damping = np.clip(np.where(better, damping / 10, damping * 10), 1e-9, 1e9)
    return states, blocks


def _limits(variable: Variable, limits: Limits) -> tuple[float, float, float]:
    """Return start value, lower and upper bound of a parameter."""
    entries = limits if isinstance(limits, tuple | list | np.ndarray) else (limits,)
    numbers = tuple(float_or_nan(entry) for entry in entries)
    if len(numbers) == 1:
        numbers = (*numbers, variable.minimum, variable.maximum)
    elif len(numbers) == 2:
        numbers = (_start_between(variable, *numbers), *numbers)
    is_ordered = len(numbers) == 3 and numbers[1] <= numbers[0] <= numbers[2] > numbers[1]
    if not (is_ordered and np.isfinite(numbers[0])):
        raise ConfigError(
            f"{variable.name!r}: expected a start, (low, high) or (start, low, high) "
            f"with low <= start <= high, got {shown(limits)}"
        )
    return numbers[0], numbers[1], numbers[2]


def _start_between(variable: Variable, low: float, high: float) -> float:
    if low <= variable.start_number <= high:
        return variable.start_number
    return (low + high) / 2


def _measured_states(
    initial_states: Mapping[str, str | float], trajectories: Sequence[Trajectory]
) -> FloatArray:
    """Return the initial states from the first samples or from numbers, shape (states, W)."""
    states = np.empty((len(initial_states), len(trajectories)))
    for k, (name, source) in enumerate(initial_states.items()):
        if isinstance(source, str):
            source = check_text("initial_states", source)
            if source not in trajectories[0].outputs:
                raise unknown_name("measured output", source, trajectories[0].outputs)
            states[k] = [trajectory.outputs[source][0] for trajectory in trajectories]
        else:
            states[k] = check_number(f"the initial state {shown(name)}", source)
    return states


def _scales(
    given: Mapping[str, float], trajectories: Sequence[Trajectory], outputs: Sequence[str]
) -> FloatArray:
    """Return the scale of each output, shape (outputs,)."""
    for name, scale in given.items():
        if check_text("scales", name) not in outputs:
            raise unknown_name("measured output", name, outputs)
        check_number(f"the scale of {name!r}", scale, positive=True)
    spread = {
        n: float(np.std(np.concatenate([t.outputs[n] for t in trajectories]))) for n in outputs
    }
    return np.array([float(given.get(name, spread[name] or 1.0)) for name in outputs])
