"""The equation of motion of a single pendulum, fitted to free swings by linear least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.distributions import Normal
from fmugym.errors import ConfigError
from fmugym.identification.statistics import (
    confidence_intervals,
    information_inverse,
    newey_west,
    normal_distributions,
)
from fmugym.identification.trajectory import is_repeat
from fmugym.pool.base import FloatArray

__all__ = ["SwingFit", "fit_swing"]

Signals = npt.ArrayLike | Sequence[npt.ArrayLike]


@dataclass(frozen=True, eq=False)
class SwingFit:
    """What ``fit_swing`` found.

    Attributes:
        values: ``p1`` [1/s], ``p2`` [1/s^2] and, if it was asked for, ``p3`` [rad/s^2].
        standard_errors: In the units of the values.
        covariance: Of the values, in their order, shape (k, k).
        degrees_of_freedom: Samples less values.
        rms: Of the residuals of the acceleration, in rad/s^2.
        g: Acceleration due to gravity, in m/s^2.
    """

    values: dict[str, float]
    standard_errors: dict[str, float]
    covariance: FloatArray
    degrees_of_freedom: int
    rms: float
    g: float

    @property
    def l(self) -> float:  # noqa: E743  (the FMU's own name)
        """The length g / p2 of a point-mass pendulum, in m."""
        return self.g / self.values["p2"]

    def confidence_intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return lower and upper end by name, the length ``l`` [m] among them."""
        values = {**self.values, "l": self.l}
        error = self.l / self.values["p2"] * self.standard_errors["p2"]
        errors = {**self.standard_errors, "l": abs(error)}
        return confidence_intervals(values, errors, self.degrees_of_freedom, level)

    def parameters(self, mass: float) -> dict[str, float]:
        """Convert to parameters of the bundled pendulum, a point mass with I = m l^2.

        Args:
            mass: In kg; a free swing says nothing of it.

        Returns:
            ``m`` [kg], ``l`` [m], ``b`` [N m s/rad] and, if it was fitted, ``c`` [N m].
        """
        inertia = mass * self.l**2
        found = {"m": mass, "l": self.l, "b": self.values["p1"] * inertia}
        return found | ({"c": self.values["p3"] * inertia} if "p3" in self.values else {})

    def distributions(self, mass: float) -> dict[str, float | Normal]:
        """Give the parameters as normal distributions, each for itself; see ``parameters``.

        The standard deviations are the standard errors, propagated to first order; l, b and c
        are not below 0.
        """
        found = self.parameters(mass)
        names = [name for name in found if name != "m"]
        slopes = self._slopes(mass, [found[name] for name in names])
        errors = np.sqrt(np.diag(slopes @ self.covariance @ slopes.T))
        values = {name: max(0.0, found[name]) for name in names}
        bounds = dict.fromkeys(names, (0.0, np.inf))
        spread = dict(zip(names, errors.tolist(), strict=True))
        return {"m": mass, **normal_distributions(values, spread, bounds)}

    def _slopes(self, mass: float, found: list[float]) -> FloatArray:
        """Differentiate l, b and c with respect to p1, p2 and p3."""
        p2 = self.values["p2"]
        slopes = mass * self.l**2 * np.eye(len(found))[[1, 0, *range(2, len(found))]]
        slopes[0, 0] = slopes[0, 1] = 0.0
        slopes[:, 1] = -2.0 / p2 * np.array(found)
        slopes[0, 1] = -self.l / p2
        return slopes


def fit_swing(
    time: float | Signals,
    q: Signals,
    q_dot: Signals,
    *,
    coulomb: bool = False,
    v_c: float = 0.05,
    g: float = 9.81,
    correlation_time: float = 0.5,
) -> SwingFit:
    """Fit a pendulum's equation of motion to free swings.

    The model is ``q_ddot = -p1 q_dot - p2 sin(q)``, where p1 = b / I and p2 = m g r / I; with
    ``coulomb=True`` it has the further term ``-p3 tanh(q_dot / v_c)``, p3 = c / I. Without it, the
    Coulomb friction of a plant goes into p1, which comes out too large. Accelerations are central
    differences of the velocities, which make p2 too small by the fraction (w h)^2 / 6 at the
    angular frequency w and the sampling interval h: 0.7 % for 10 rad/s at 50 Hz.

    Standard errors are those of Newey and West, as differences of a noise are correlated.

    Args:
        time: The sampling instants in seconds, shape (n,), the same for all swings; or a list of
            such, one for each swing; or the sampling interval.
        q: Angles in rad, 0 hanging; shape (n,) or (swings, n), or a list of arrays.
        q_dot: Angular velocities in rad/s, as q.
        coulomb: Whether to fit Coulomb friction.
        v_c: Width of the Coulomb friction in rad/s; see the readme of the pendulum FMU.
        g: Acceleration due to gravity in m/s^2.
        correlation_time: How long residuals may be correlated, in seconds.

    Returns:
        Values, standard errors and confidence intervals.

    Raises:
        ConfigError: If the arrays do not fit together, or the swings do not determine the values.
        ImportError: From the confidence intervals, if SciPy is not there.
    """
    swings = [_regression(*swing, coulomb, v_c) for swing in _swings(time, q, q_dot)]
    regressors = np.concatenate([x for x, _, _ in swings])
    inverse = information_inverse(regressors)
    names = ["p1", "p2", "p3"][: regressors.shape[1]]
    if inverse.undetermined.any() or len(regressors) <= len(names):
        raise ConfigError("the swings do not determine the values: is there motion in them?")
    estimate = inverse.matrix @ regressors.T @ np.concatenate([y for _, y, _ in swings])
    residuals = [y - x @ estimate for x, y, _ in swings]
    scores = [x * r[:, np.newaxis] for (x, _, _), r in zip(swings, residuals, strict=True)]
    lags = min(round(correlation_time / swings[0][2]), max(map(len, scores)) // 2)
    covariance = inverse.matrix @ newey_west(scores, lags) @ inverse.matrix
    return _result(names, estimate, covariance, np.concatenate(residuals), g)


def _result(
    names: list[str], estimate: FloatArray, covariance: FloatArray, residual: FloatArray, g: float
) -> SwingFit:
    errors = np.sqrt(np.diag(covariance)).tolist()
    return SwingFit(
        values=dict(zip(names, estimate.tolist(), strict=True)),
        standard_errors=dict(zip(names, errors, strict=True)),
        covariance=covariance,
        degrees_of_freedom=len(residual) - len(names),
        rms=float(np.sqrt(np.mean(residual**2))),
        g=g,
    )


def _swings(
    time: float | Signals, q: Signals, q_dot: Signals
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Sort the arguments by swing, without stale samples."""
    angles, velocities = _rows(q), _rows(q_dot)
    if isinstance(time, int | float):
        times: list[FloatArray] = [
            np.arange(len(angle), dtype=np.float64) * time for angle in angles
        ]
    else:
        times = _rows(time)
    if len(times) == 1:
        times *= len(angles)
    shapes = [[array.shape for array in arrays] for arrays in (times, angles, velocities)]
    if not shapes[0] == shapes[1] == shapes[2]:
        raise ConfigError(f"time, q and q_dot must have the same shapes, got {shapes}")
    together = zip(times, angles, velocities, strict=True)
    return [_fresh(np.stack(swing)) for swing in together]


def _fresh(swing: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    time, q, q_dot = swing[:, ~is_repeat(swing[1:])]
    if len(time) < 3 or not (np.diff(time) > 0).all() or not np.isfinite(swing).all():
        raise ConfigError("a swing needs three samples, at increasing times, all of them finite")
    return time, q, q_dot


def _rows(signals: Any) -> list[FloatArray]:
    """One array for each swing."""
    several = all(np.ndim(row) == 1 for row in signals)
    return [np.asarray(row, np.float64) for row in (signals if several else [signals])]


def _regression(
    time: FloatArray, q: FloatArray, q_dot: FloatArray, coulomb: bool, v_c: float
) -> tuple[FloatArray, FloatArray, float]:
    """Set up one swing: regressors, accelerations, and the sampling interval in s."""
    velocity = q_dot[1:-1]
    columns = [-velocity, -np.sin(q[1:-1])]
    if coulomb:
        columns.append(-np.tanh(velocity / v_c))
    accelerations = (q_dot[2:] - q_dot[:-2]) / (time[2:] - time[:-2])
    return np.column_stack(columns), accelerations, float(np.median(np.diff(time)))
