"""Measured against simulated, in numbers and in a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmugym.errors import unknown_name
from fmugym.identification.trajectory import Trajectory
from fmugym.pool.base import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Comparison", "plot_comparison"]

NUM_RESAMPLES = 2000


@dataclass(frozen=True, eq=False)
class Comparison:
    """Trajectories and what the FMU makes of them.

    Attributes:
        trajectories: The measured ones, without their stale samples.
        simulated: The outputs at the same instants by name, for each trajectory.
        initial_values: The start values by name from which each was simulated.
    """

    trajectories: tuple[Trajectory, ...]
    simulated: tuple[dict[str, FloatArray], ...]
    initial_values: tuple[dict[str, float], ...]

    def residuals(self, output: str) -> list[FloatArray]:
        """Return simulated less measured, an array for each trajectory."""
        known = self.trajectories[0].outputs
        if output not in known:
            raise unknown_name("measured output", output, known)
        pairs = zip(self.simulated, self.trajectories, strict=True)
        return [simulated[output] - measured.outputs[output] for simulated, measured in pairs]

    def rms(self, output: str) -> float:
        """Return the root mean square of the residuals, in the unit of the output."""
        return float(np.sqrt(np.mean(np.concatenate(self.residuals(output)) ** 2)))

    def rms_interval(self, output: str, level: float = 0.95, seed: int = 0) -> tuple[float, float]:
        """Estimate how far the RMS depends on the trajectories that happen to be there.

        A bootstrap that draws whole trajectories (windows) with replacement; Efron and
        Tibshirani, "An Introduction to the Bootstrap" (1993). It needs ten of them or more to
        mean much.

        Args:
            output: Name of the output.
            level: Probability of the interval.
            seed: Of the draws.

        Returns:
            Lower and upper end of the interval, in the unit of the output.
        """
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
    labels: dict[str, str] | None = None,
) -> Figure:
    """Draw measured and simulated outputs over time.

    Args:
        comparison: From a fit or a prediction.
        outputs: Which outputs to draw, one below the other; None for all.
        labels: Names with units for the axes, by output.

    Returns:
        A figure of matplotlib, to be saved with ``figure.savefig(path)``.
    """
    from matplotlib.figure import Figure

    outputs = list(comparison.trajectories[0].outputs) if outputs is None else outputs
    figure = Figure(figsize=(8, 1 + 2 * len(outputs)), layout="constrained")
    axes = figure.subplots(len(outputs), sharex=True, squeeze=False)[:, 0]
    for ax, output in zip(axes, outputs, strict=True):
        _draw_output(ax, comparison, output)
        ax.set_ylabel((labels or {}).get(output, output))
    axes[0].legend(loc="upper right")
    axes[-1].set_xlabel("time [s]")
    return figure


def _draw_output(ax: Axes, comparison: Comparison, output: str) -> None:
    comparison.residuals(output)  # refuses an unknown name
    labels = ("measured", "simulated")
    for measured, simulated in zip(comparison.trajectories, comparison.simulated, strict=True):
        points = measured.outputs[output]
        ax.plot(measured.time, points, ".", ms=3, color="0.6", label=labels[0])
        ax.plot(measured.time, simulated[output], "-", lw=1.2, color="#0072b2", label=labels[1])
        labels = ("", "")
    ax.grid(alpha=0.3)
