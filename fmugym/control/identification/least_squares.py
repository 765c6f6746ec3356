"""Least-squares problem behind an output-error fit, and the statistics of its residuals.

Variable projection eliminates the initial states of the trajectories. For given parameters, the fit
of each trajectory finds its best initial state. The Jacobian of the parameters then loses its part
in the directions of these states (Kaufman's form; see Golub and Pereyra, "Separable nonlinear least
squares", Inverse Problems 19, 2003). The size of the optimization therefore does not depend on the
number of trajectories. The statistics are information, covariances and correlation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fmugym.checks import Spellings, by_own_names, check_number, float_or_nan, items_of
from fmugym.control.identification.simulator import FitSettings, Simulator
from fmugym.control.identification.trajectory import Comparison, Trajectory, common_names
from fmugym.environment.fmu_variables import start_variable
from fmugym.errors import ConfigError, SimulationError, shown
from fmugym.extras import imported
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray, MaskArray

__all__ = [
    "Correlation",
    "ParameterLimits",
    "Problem",
    "memory_of",
    "newey_west",
    "sandwich",
    "start_between",
]

_RANK_TOLERANCE = 1e-9
"""Singular values below this fraction of the largest one count as zero."""

_FALSE_ALARM = 1e-3
"""Share of white noise that counts as correlated."""

ROUNDING = 1e-6
"""Residuals below this, in units of their scale, are rounding errors."""

_MOST_LAGS = 20
"""Of the autocorrelations that the test for white noise looks at."""


def sandwich(jacobian: FloatArray, scores: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of an estimate, and the information: its inverse; shapes (k, k).

    A singular value decomposition of J with columns scaled to length one shows the directions of
    which the data tell nothing. The information is 0 along them, and the variance of a parameter
    that changes along them is infinite.

    Args:
        jacobian: The derivatives J of the residuals r, shape (n, k).
        scores: The covariance of J' r, shape (k, k).
    """
    lengths = np.linalg.norm(jacobian, axis=0)
    safe = np.where(lengths > 0, lengths, 1.0)
    _, values, rows = np.linalg.svd(jacobian / safe, full_matrices=False)
    kept = values > _RANK_TOLERANCE * values.max(initial=0.0)
    told, bread = rows[kept], values[kept, np.newaxis] ** 2
    middle = (told / safe) @ scores @ (told / safe).T
    narrow, wide = told / bread / safe, told * bread * safe
    covariance = narrow.T @ middle @ narrow
    unknown = np.flatnonzero((np.abs(rows[~kept]) > 1e-6).any(axis=0) | (lengths == 0))
    covariance[unknown, unknown] = np.inf
    information = wide.T @ np.linalg.pinv(middle, _RANK_TOLERANCE, hermitian=True) @ wide
    return covariance, information


class Correlation(NamedTuple):
    """Correlation of the residuals of an output with earlier ones.

    Attributes:
        first: The correlation with the residual one sample before.
        is_noise: Whether correlations up to the 20th sample before are no larger than those of
            white noise, by the test of Ljung and Box, "On a measure of lack of fit in time series
            models", Biometrika 65 (1978).
    """

    first: float
    is_noise: bool

    @classmethod
    def of(cls, residuals: Sequence[FloatArray]) -> Correlation:
        """Judge the residuals of an output, an array (n,) for each experiment."""
        count = sum(map(len, residuals))
        lags = range(1, 1 + min(_MOST_LAGS, max(map(len, residuals)) - 1))
        power = sum(float(one @ one) for one in residuals)
        if not lags or power <= count * ROUNDING**2:
            return cls(0.0, True)
        found = [sum(float(one[lag:] @ one[:-lag]) for one in residuals) / power for lag in lags]
        statistic = (
            count
            * (count + 2)
            * sum(one**2 / (count - lag) for one, lag in zip(found, lags, strict=True))
        )
        chi2 = imported("scipy.stats", "identification").chi2
        return cls(found[0], bool(statistic <= chi2.ppf(1 - _FALSE_ALARM, len(lags))))


def memory_of(correlation: float, count: int) -> int:
    """Choose the lags of ``newey_west`` for a process of first order.

    Andrews, "Heteroskedasticity and autocorrelation consistent covariance matrix estimation",
    Econometrica 59 (1991).

    Args:
        correlation: Between neighbouring samples; NaN, which is not known, counts as the largest.
        count: The number of samples.
    """
    slow = 0.99 if math.isnan(correlation) else min(max(correlation, 0.0), 0.99)
    return 1 + int(1.1447 * (4 * slow**2 / (1 - slow**2) ** 2 * count) ** (1 / 3))


def newey_west(scores: Sequence[FloatArray], lags: int) -> FloatArray:
    """Sum the scores' autocovariances with Bartlett's weights.

    Newey and West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation
    consistent covariance matrix", Econometrica 55 (1987).

    Args:
        scores: Regressors times residuals, an array (n, k) for each experiment.
        lags: The largest lag with a weight above 0, in samples.

    Returns:
        The covariance of the sum of the scores, shape (k, k).
    """
    total = sum(score.T @ score for score in scores)
    for lag in range(1, lags + 1):
        crossed = sum(score[lag:].T @ score[:-lag] for score in scores if len(score) > lag)
        total = total + (1 - lag / (lags + 1)) * (crossed + np.transpose(crossed))
    return np.asarray(total)


ParameterLimits = float | tuple[float, float] | tuple[float, float, float]

_DIFFERENCE = 1e-6
"""Step of the finite differences, as a fraction of a value's typical size."""

FAILED = 1e3
"""Residual of a failed simulation, in units of the scale; it keeps the optimizer away."""

_MOST_EVALUATIONS = 100
"""Largest number of evaluations of an optimization."""

_MAX_ITERATIONS = 50
"""Largest number of iterations in the fit of the initial states."""

_DESCENTS = 3
"""Of the candidates, as many of the best ones are starts of an optimization."""

_REWEIGHTINGS = 2
"""Number of times that outputs are weighted anew, by the noise of the residuals."""

_LEAST_NOISE = 1e-6
"""Of an output, as a part of its standard deviation."""


class _Block(NamedTuple):
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

    Attributes:
        trajectories: The trajectories without stale samples.
        bounds: Lower and upper bound of each parameter by name.
        start: The start values of the parameters, shape (k,).
    """

    def __init__(
        self,
        experiment: FitSettings,
        parameters: Mapping[str, ParameterLimits],
        trajectories: Sequence[Trajectory],
    ) -> None:
        outputs, _ = common_names(trajectories)
        repeats = not experiment.drop_repeats
        self.trajectories = tuple(t if repeats else t.without_repeats() for t in trajectories)
        self._state_names = list(experiment.initial_states)
        self._states = _measured_states(experiment.initial_states, self.trajectories)
        self._counted = [_counted(t, experiment) for t in self.trajectories]
        names = [*parameters, *self._state_names]
        self._rows = range(len(names))
        variables = [_settable(experiment, name) for name in names]
        self._set_limits(variables, parameters)
        measured = Spellings("measured output", outputs)
        scales = by_own_names("scales", experiment.scales, measured.require)
        self._scales = _scales(scales, self.trajectories, outputs)
        self._given = [name in scales for name in outputs]
        self._last = np.empty(0), self._states
        count = 1 + len(self._rows)
        self._simulator = Simulator(experiment, self.trajectories, variables, count)

    def _set_limits(
        self, variables: Sequence[Variable], parameters: Mapping[str, ParameterLimits]
    ) -> None:
        count = len(parameters)
        limits = [_limits(v, parameters[v.name]) for v in variables[:count]]
        self.bounds = {name: one[1:] for name, one in zip(parameters, limits, strict=True)}
        limits += [(0.0, v.minimum, v.maximum) for v in variables[count:]]
        starts, self._low, self._high = np.reshape(limits, (-1, 3)).T
        self.start = starts[:count]
        sizes = np.maximum(np.abs(starts), [v.nominal or 0.0 for v in variables])
        self._differences = _DIFFERENCE * np.where(sizes > 0.0, sizes, 1.0)

    def close(self) -> None:
        """Free the simulator."""
        self._simulator.close()

    def solve(self, candidates: int = 1) -> tuple[Any, list[float]]:
        """Minimize the residuals from several starts.

        Args:
            candidates: Points within the bounds, of which the best ones are starts.

        Returns:
            SciPy's result, and the costs that the starts have come to, the best first.

        Raises:
            ConfigError: If there are several candidates, and a parameter has no bounds.
        """
        self._require_samples()
        self.compare(self.start, refit=False)  # fails early with the FMU's reason
        measured, found = self._states, []
        for start in self._starts(candidates):
            self._states = measured
            found.append((self._descend(start), self._states))
        found.sort(key=lambda one: one[0].cost)
        solution, self._states = found[0]
        spread, costs = self._scales, [float(one.cost) for one, _ in found]
        for _ in range(0 if all(self._given) or len(self._given) == 1 else _REWEIGHTINGS):
            noise = np.sqrt(np.mean(self._series(solution.fun) ** 2, axis=0)) * self._scales
            noise = np.maximum(noise, _LEAST_NOISE * spread)
            self._scales = np.where(self._given, self._scales, noise)
            solution = self._descend(solution.x)
        return solution, costs

    def _require_samples(self) -> None:
        count = sum(int(one.sum()) for one in self._counted) * len(self._given)
        wanted = len(self.start) + self._num_states
        if count <= wanted:
            raise ConfigError(
                f"{count} measured values are too few for {wanted} values to fit: the log is too "
                "short, or the wash-in too long"
            )

    @property
    def _num_states(self) -> int:
        return (len(self._rows) - len(self.start)) * len(self.trajectories)

    def _starts(self, candidates: int) -> list[FloatArray]:
        """The given start; or the best of it and of points that are spread within the bounds."""
        if candidates == 1:
            return [self.start]
        count = len(self.start)
        low, high = self._low[:count, np.newaxis], self._high[:count, np.newaxis]
        for name, ends in self.bounds.items():
            if not np.isfinite(ends).all():
                raise ConfigError(f"{name!r} needs a lowest and a highest value, got {ends}")
        rng = np.random.default_rng(0)
        strata = rng.permuted(np.tile(np.arange(candidates), (count, 1)), axis=1)
        points = low + (high - low) * (strata + rng.random(strata.shape)) / candidates
        points[:, 0] = self.start
        return list(points[:, np.argsort(self._costs(points))[:_DESCENTS]].T)

    def _costs(self, points: FloatArray) -> FloatArray:
        """The sums of squares at some points, shape (k, n), with the measured initial states."""
        costs: list[FloatArray] = []
        for first in range(0, points.shape[1], self._simulator.num_sets):
            part = points[:, first : first + self._simulator.num_sets]
            values = np.concatenate([self._join(one, self._states) for one in part.T], axis=1)
            costs.append(sum((e**2).sum(axis=1) for e in self._errors(values)))
        found = np.concatenate(costs)
        return np.where(np.isfinite(found), found, np.inf)

    def _descend(self, start: FloatArray) -> Any:
        """Minimize the residuals from a start."""
        count = len(self.start)
        return imported("scipy.optimize", "identification").least_squares(
            self._residuals,
            start,
            jac=self._jacobian,
            bounds=(self._low[:count], self._high[:count]),
            x_scale="jac",
            max_nfev=_MOST_EVALUATIONS,
        )

    def compare(self, parameters: FloatArray, *, refit: bool = True) -> Comparison:
        """Simulate all trajectories.

        Args:
            parameters: Their values, shape (k,).
            refit: Whether to fit the initial states.
        """
        values = self._fit_states(parameters)[0] if refit else self._states
        simulated = self._simulator.simulate(self._join(parameters, values))
        if not all(np.isfinite(outputs).all() for outputs in simulated):
            raise SimulationError(f"the simulation failed: {self._simulator.failure}")
        names = self._simulator.outputs
        return Comparison(
            self.trajectories,
            tuple(dict(zip(names, outputs[0].T, strict=True)) for outputs in simulated),
            tuple(dict(zip(self._state_names, s, strict=True)) for s in values.T.tolist()),
        )

    def uncertainty(self, solution: Any) -> dict[str, Any]:
        """Estimate the uncertainty of the parameters, as attributes of ``FitResult``.

        Residuals that are no white noise count as correlated (Newey and West).
        """
        freedom = max(1, len(solution.fun) - len(self.start) - self._num_states)
        correlations = self._correlations(solution)
        noise = np.mean(self._series(solution.fun) ** 2, axis=0) * len(solution.fun) / freedom
        deviations = np.sqrt(np.maximum(noise, ROUNDING**2))
        weighed = solution.jac * np.tile(deviations, len(solution.fun) // len(noise))[:, np.newaxis]
        scores = weighed.T @ weighed
        if not all(one.is_noise for one in correlations.values()):
            scores, freedom = self._correlated(solution, correlations)
        covariance, information = sandwich(solution.jac, scores)
        return {
            "covariance": covariance,
            "information": information,
            "degrees_of_freedom": freedom,
            "correlations": correlations,
        }

    def _correlations(self, solution: Any) -> dict[str, Correlation]:
        parts = self._by_trajectory(self._series(solution.fun))
        names = enumerate(self._simulator.outputs)
        return {name: Correlation.of([one[:, k] for one in parts]) for k, name in names}

    def _correlated(
        self, solution: Any, correlations: Mapping[str, Correlation]
    ) -> tuple[FloatArray, int]:
        """Covariance of J' r for correlated residuals, and its degrees of freedom."""
        products = solution.jac * solution.fun[:, np.newaxis]
        sums = products.reshape(-1, len(correlations), len(self.start)).sum(axis=1)
        lags = memory_of(max(one.first for one in correlations.values()), len(sums))
        parts = self._by_trajectory(sums)
        blocks = sum(max(1, len(part) // (lags + 1)) for part in parts)
        factor = blocks / max(1, blocks - len(self.start))
        return newey_west(parts, lags) * factor, max(1, blocks - len(self.start))

    def _series(self, residuals: FloatArray) -> FloatArray:
        """The residuals of all trajectories, a column for each output."""
        return residuals.reshape(-1, len(self._given))

    def _by_trajectory(self, rows: FloatArray) -> list[FloatArray]:
        return np.split(rows, np.cumsum([one.sum() for one in self._counted])[:-1])

    def _residuals(self, parameters: FloatArray) -> FloatArray:
        """Residuals that SciPy minimizes, at the best initial states."""
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
        return [
            _Block(e[0], (e[1:] - e[0]).T / steps[list(rows), w])
            for w, e in enumerate(self._errors(values))
        ]

    def _join(self, parameters: FloatArray, states: FloatArray) -> FloatArray:
        """Return the values for one simulation of each trajectory, shape (names, 1, W)."""
        shared = np.tile(parameters[:, np.newaxis], len(self.trajectories))
        return np.concatenate([shared, states])[:, np.newaxis]

    def _errors(self, values: FloatArray) -> list[FloatArray]:
        """Simulate, and return each trajectory's scaled residuals, shape (sets, n * outputs)."""
        found = []
        parts = zip(self.trajectories, self._simulator.simulate(values), self._counted, strict=True)
        for one, simulated, counted in parts:
            measured = np.stack([one.outputs[n] for n in self._simulator.outputs], axis=1)
            scaled = ((simulated - measured) / self._scales)[:, counted]
            found.append(scaled.reshape(len(scaled), -1))
        return found


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
    for _ in range(_MAX_ITERATIONS):
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


def _limits(variable: Variable, limits: ParameterLimits) -> tuple[float, float, float]:
    """Return start value, lower and upper bound of a parameter."""
    is_one = not isinstance(limits, tuple | list | np.ndarray)
    numbers = tuple(map(float_or_nan, [limits] if is_one else items_of(limits)))
    if len(numbers) == 1:
        numbers = (*numbers, variable.minimum, variable.maximum)
    elif len(numbers) == 2:
        numbers = (start_between(variable.start_number, *numbers), *numbers)
    is_ordered = len(numbers) == 3 and numbers[1] <= numbers[0] <= numbers[2] > numbers[1]
    if not (is_ordered and np.isfinite(numbers[0])):
        raise ConfigError(
            f"{variable.name!r}: expected a start, (low, high) or (start, low, high) "
            f"with low <= start <= high, got {shown(limits)}"
        )
    return numbers[0], numbers[1], numbers[2]


def _settable(experiment: FitSettings, name: str) -> Variable:
    variable = start_variable(experiment.fmu.description, name, 0.0)
    if variable.kind != "real":
        raise ConfigError(f"{name!r} is of type {variable.type}: only Reals can be fitted")
    if name in experiment.fixed:
        raise ConfigError(f"{name!r} is both fixed and to be fitted")
    return variable


def start_between(value: float, low: float, high: float) -> float:
    """A value, or the middle of a range that it is not in."""
    return value if low <= value <= high else (low + high) / 2


def _counted(trajectory: Trajectory, experiment: FitSettings) -> MaskArray:
    """Samples of a trajectory after the wash-in."""
    since, wash_in = trajectory.time - trajectory.time[0], experiment.wash_in
    begin = -1.0 if wash_in is None else check_number("wash_in", wash_in, 0.0)
    counted = since > begin
    if not counted.any():
        raise ConfigError(f"a log of {since[-1]:g} s has no samples after a wash-in of {begin:g} s")
    return np.asarray(counted)


def _measured_states(
    initial_states: Mapping[str, str | float], trajectories: Sequence[Trajectory]
) -> FloatArray:
    """Return the initial states from the first samples or from numbers, shape (states, W)."""
    states = np.empty((len(initial_states), len(trajectories)))
    measured = Spellings("measured output", trajectories[0].outputs)
    for k, (name, source) in enumerate(initial_states.items()):
        if isinstance(source, str):
            own = measured.require(source)
            states[k] = [trajectory.outputs[own][0] for trajectory in trajectories]
        else:
            states[k] = check_number(f"the initial state {shown(name)}", source)
    return states


def _scales(
    given: Mapping[str, float], trajectories: Sequence[Trajectory], outputs: Sequence[str]
) -> FloatArray:
    """Return the scale of each output, shape (outputs,)."""
    for name, scale in given.items():
        check_number(f"the scale of {name!r}", scale, positive=True)
    spread = {
        n: float(np.std(np.concatenate([t.outputs[n] for t in trajectories]))) for n in outputs
    }
    return np.array([float(given.get(name, spread[name] or 1.0)) for name in outputs])
