"""Fit of a single pendulum's equation of motion to free swings, by linear least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.checks import check_flag, check_number, float_or_nan
from fmugym.distributions import Normal
from fmugym.errors import ConfigError, shown
from fmugym.identification.statistics import (
    Estimate,
    information_inverse,
    newey_west,
    normal_distributions,
)
from fmugym.identification.trajectory import Trajectory, float_array
from fmugym.pool.base import FloatArray
from fmugym.signals import ordinary

__all__ = ["SwingFit", "fit_swing"]

Signals = npt.ArrayLike | Sequence[npt.ArrayLike]


@dataclass(frozen=True, eq=False)
class SwingFit(Estimate):
    """The result of ``fit_swing``.

    The values are ``p1`` [1/s], ``p2`` [1/s^2] and, with Coulomb friction, ``p3`` [rad/s^2].

    Attributes:
        rms: Root mean square of the residuals of the acceleration, in rad/s^2.
        g: Acceleration due to gravity, in m/s^2.
    """

    rms: float
    g: float

    @property
    def l(self) -> float:  # noqa: E743  (the FMU's own name)
        """The length g / p2 of a point-mass pendulum, in m."""
        return self.g / self.values["p2"]

    def confidence_intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return lower and upper end by name, including the length ``l`` [m].

        Raises:
            ConfigError: If the level is not between 0 and 1.
        """
        half = abs(self.l / self.values["p2"] * self.standard_errors["p2"]) * self.factor(level)
        return super().confidence_intervals(level) | {"l": (self.l - half, self.l + half)}

    def parameters(self, mass: float) -> dict[str, float]:
        """Convert to parameters of the bundled pendulum, a point mass with I = m l^2.

        Args:
            mass: The mass in kg, which a free swing does not determine.

        Returns:
            ``m`` [kg], ``l`` [m], ``b`` [N m s/rad] and, if it was fitted, ``c`` [N m].

        Raises:
            ConfigError: If the mass is not positive and finite.
        """
        mass = check_number("mass", mass, positive=True)
        inertia = mass * self.l**2
        found = {"m": mass, "l": self.l, "b": self.values["p1"] * inertia}
        return found | ({"c": self.values["p3"] * inertia} if "p3" in self.values else {})

    def distributions(self, mass: float) -> dict[str, float | Normal]:
        """Return the parameters as independent normal distributions; see ``parameters``.

        The standard deviations are the standard errors, propagated to first order. The
        distributions of l, b and c begin at 0.

        Raises:
            ConfigError: If the mass is not positive and finite.
        """
        found = self.parameters(mass)
        mass = found["m"]
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

    The model is ``q_ddot = -p1 q_dot - p2 sin(q)``, where p1 = b / I and p2 = m g r / I. With
    ``coulomb=True`` it has the additional term ``-p3 tanh(q_dot / v_c)``, where p3 = c / I. Without
    this term, Coulomb friction of the plant makes p1 too large. The accelerations are central
    differences of the velocities. They make p2 too small by the fraction (w h)^2 / 6 at the angular
    frequency w and the sampling interval h: 0.7 % for 10 rad/s at 50 Hz.

    Differences of noise are correlated, so the standard errors are those of Newey and West.

    Args:
        time: The sampling instants in seconds, shape (n,), for all swings; or a list of such
            arrays, one for each swing; or the sampling interval.
        q: Angles in rad, 0 hanging; shape (n,) or (swings, n), or a list of arrays.
        q_dot: Angular velocities in rad/s, in the same form as q.
        coulomb: Whether to fit Coulomb friction.
        v_c: Width of the Coulomb friction in rad/s; see the readme of the pendulum FMU.
        g: Acceleration due to gravity in m/s^2.
        correlation_time: How long residuals may be correlated, in seconds.

    Returns:
        Values, standard errors and confidence intervals.

    Raises:
        ConfigError: If an argument has a wrong type or range, if the arrays do not fit together,
            or if the swings do not determine the values.
        ImportError: From the confidence intervals, if SciPy is not installed.
    """
    coulomb, g = check_flag("coulomb", coulomb), check_number("g", g, positive=True)
    v_c = check_number("v_c", v_c, positive=True)
    correlation_time = check_number("correlation_time", correlation_time, 0.0)
    swings = [_regression(swing, coulomb, v_c) for swing in _swings(time, q, q_dot)]
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
    residual = np.concatenate(residuals)
    return SwingFit(
        dict(zip(names, estimate.tolist(), strict=True)),
        covariance,
        len(residual) - len(names),
        rms=float(np.sqrt(np.mean(residual**2))),
        g=g,
    )


def _swings(time: float | Signals, q: Signals, q_dot: Signals) -> list[Trajectory]:
    """Return each swing without stale samples."""
    angles, velocities = _several("q", q), _several("q_dot", q_dot)
    if np.isnan(interval := float_or_nan(time)):
        times = _several("time", time)
    else:
        period = check_number("time", interval, positive=True)
        times = [np.arange(angle.size, dtype=np.float64) * period for angle in angles]
    if len(times) == 1:
        times *= len(angles)
    counts = [len(arrays) for arrays in (times, angles, velocities)]
    if len(set(counts)) > 1:
        raise ConfigError(f"time, q and q_dot must be of the same swings, got {counts} of them")
    together = zip(times, angles, velocities, strict=True)
    swings = [Trajectory(t, {"q": x, "q_dot": v}).without_repeats() for t, x, v in together]
    if min(map(len, swings)) < 3:
        raise ConfigError("a swing needs at least three samples")
    return swings


def _several(what: str, signals: Any) -> list[FloatArray]:
    """Return one array for each swing."""
    try:
        several = len(signals) > 0 and all(np.ndim(row) == 1 for row in signals)
        rows = list(signals) if several else [signals]
    except ordinary(Exception):  # objects may do anything when numpy looks at them
        raise ConfigError(f"{what} must be an array or a list, not {shown(signals)}") from None
    return [float_array(what, row) for row in rows]


def _regression(
    swing: Trajectory, coulomb: bool, v_c: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the regressors, the accelerations, and the sampling interval in s of one swing."""
    time, q, q_dot = swing.time, swing.outputs["q"], swing.outputs["q_dot"]
    velocity = q_dot[1:-1]
    columns = [-velocity, -np.sin(q[1:-1])]
    if coulomb:
        columns.append(-np.tanh(velocity / v_c))
    accelerations = (q_dot[2:] - q_dot[:-2]) / (time[2:] - time[:-2])
    return np.column_stack(columns), accelerations, float(np.median(np.diff(time)))
