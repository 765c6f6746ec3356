"""Comparison of measurement and simulation, in numbers and in a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmugym.checks import check_integer, check_mapping, check_number, check_option, check_text
from fmugym.errors import ConfigError, shown
from fmugym.identification.trajectory import Trajectory
from fmugym.pool.base import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fmugym.figures import Figure

__all__ = ["Comparison", "plot_comparison"]

NUM_RESAMPLES = 2000
"""Resamples of the bootstrap."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured trajectories and their simulations.

    Attributes:
        trajectories: The measured trajectories, without stale samples.
        simulated: The simulated outputs by name at the same instants, for each trajectory.
        initial_values: The start values by name of each simulation.
    """

    trajectories: tuple[Trajectory, ...]
    simulated: tuple[dict[str, FloatArray], ...]
    initial_values: tuple[dict[str, float], ...]

    def residuals(self, output: str) -> list[FloatArray]:
        """Return simulated minus measured values, an array for each trajectory.

        Raises:
            ConfigError: If the output was not measured.
        """
        output = check_option("measured output", output, self.trajectories[0].outputs)
        pairs = zip(self.simulated, self.trajectories, strict=True)
        return [simulated[output] - measured.outputs[output] for simulated, measured in pairs]

    def rms(self, output: str) -> float:
        """Return the root mean square of the residuals, in the unit of the output."""
        return float(np.sqrt(np.mean(np.concatenate(self.residuals(output)) ** 2)))

    def explained(self, output: str) -> float:
        """Return which part of the variance of the measured values the simulation explains."""
        measured = np.concatenate([one.outputs[output] for one in self.trajectories])
        return 1.0 - self.rms(output) ** 2 / (float(np.var(measured)) or 1.0)

    def rms_interval(self, output: str, level: float = 0.95, seed: int = 0) -> tuple[float, float]:
        """Estimate how much the RMS depends on the choice of trajectories.

        The bootstrap draws whole trajectories (windows) with replacement; see Efron and
        Tibshirani, "An Introduction to the Bootstrap" (1993). With fewer than ten trajectories
        the interval means little.

        Args:
            output: Name of the output.
            level: Probability of the interval, between 0 and 1.
            seed: Seed of the draws.

        Returns:
            Lower and upper end of the interval, in the unit of the output.

        Raises:
            ConfigError: If the output was not measured, or an argument is out of its range.
        """
        level = check_number("level", level, 0.0, 1.0)
        seed = check_integer("seed", seed, 0, 2**128 - 1)
        residuals = self.residuals(output)
        squares = np.array([np.sum(residual**2) for residual in residuals])
        counts = np.array([len(residual) for residual in residuals])
        shape = NUM_RESAMPLES, len(residuals)
        drawn = np.random.default_rng(seed).integers(len(residuals), size=shape)
        drawn_rms = np.sqrt(squares[drawn].sum(axis=1) / counts[drawn].sum(axis=1))
        low, high = np.quantile(drawn_rms, [0.5 - level / 2, 0.5 + level / 2])
        return float(low), float(high)


def plot_comparison(
    comparison: Comparison,
    outputs: Sequence[str] | None = None,
    labels: Mapping[str, str] | None = None,
) -> Figure:
    """Plot measured and simulated outputs over time.

    Args:
        comparison: The result of a fit or a prediction.
        outputs: The outputs to plot, one below the other; None for all.
        labels: Names with units for the axes, by output.

    Returns:
        A figure of matplotlib. ``figure.savefig(path)`` saves it.

    Raises:
        ConfigError: If an output was not measured, or an argument has a wrong type.
    """
    from fmugym.figures import Figure

    if not isinstance(comparison, Comparison):
        raise ConfigError(f"expected a Comparison, not {shown(comparison)}")
    outputs = _chosen(comparison, outputs)
    texts = {} if labels is None else check_mapping("labels", labels)
    figure = Figure(figsize=(8, 1 + 2 * len(outputs)), layout="constrained")
    axes = figure.subplots(len(outputs), sharex=True, squeeze=False)[:, 0]
    for ax, output in zip(axes, outputs, strict=True):
        _draw_output(ax, comparison, output)
        ax.set_ylabel(check_text("labels", texts.get(output, output)))
    axes[0].legend(loc="upper right")
    axes[-1].set_xlabel("time [s]")
    return figure


def _chosen(comparison: Comparison, outputs: Sequence[str] | None) -> list[str]:
    if outputs is None:
        return list(comparison.trajectories[0].outputs)
    if not isinstance(outputs, list | tuple) or not outputs:
        raise ConfigError(f"outputs must be a list of names, not {shown(outputs)}")
    known = comparison.trajectories[0].outputs
    return [check_option("measured output", output, known) for output in outputs]


def _draw_output(ax: Axes, comparison: Comparison, output: str) -> None:
    labels = ("measured", "simulated")
    for measured, simulated in zip(comparison.trajectories, comparison.simulated, strict=True):
        points = measured.outputs[output]
        ax.plot(measured.time, points, ".", ms=3, color="0.6", label=labels[0])
        ax.plot(measured.time, simulated[output], "-", lw=1.2, color="#0072b2", label=labels[1])
        labels = ("", "")
    ax.grid(alpha=0.3)
