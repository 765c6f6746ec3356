"""Comparison of measurement and simulation, in numbers and in a plot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmugym.checks import Spellings, by_own_names, check_mapping, check_text
from fmugym.errors import ConfigError, shown
from fmugym.identification.trajectory import Trajectory
from fmugym.pool.base import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fmugym.figures import Figure

__all__ = ["Comparison", "plot_comparison"]


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
        own = self._measured.require(output)
        pairs = zip(self.simulated, self.trajectories, strict=True)
        return [simulated[own] - measured.outputs[own] for simulated, measured in pairs]

    @property
    def _measured(self) -> Spellings:
        return Spellings("measured output", self.trajectories[0].outputs)

    def rms(self, output: str) -> float:
        """Return the root mean square of the residuals, in the unit of the output."""
        return float(np.sqrt(np.mean(np.concatenate(self.residuals(output)) ** 2)))

    def explained(self, output: str) -> float:
        """Return which part of the variance of the measured values the simulation explains."""
        own = self._measured.require(output)
        measured = np.concatenate([one.outputs[own] for one in self.trajectories])
        return 1.0 - self.rms(output) ** 2 / (float(np.var(measured)) or 1.0)


def plot_comparison(comparison: Comparison, labels: Mapping[str, str] | None = None) -> Figure:
    """Plot measured and simulated outputs over time, one below the other.

    Args:
        comparison: The result of a fit or a prediction.
        labels: Names with units for the axes, by output.

    Returns:
        A figure of matplotlib. ``figure.savefig(path)`` saves it.

    Raises:
        ConfigError: If an argument has a wrong type.
    """
    from fmugym.figures import Figure

    if not isinstance(comparison, Comparison):
        raise ConfigError(f"expected a Comparison, not {shown(comparison)}")
    outputs = list(comparison.trajectories[0].outputs)
    measured = Spellings("measured output", outputs)
    given = {} if labels is None else check_mapping("labels", labels)
    texts = by_own_names("labels", given, lambda name: measured.find(name) or name)
    figure = Figure(figsize=(8, 1 + 2 * len(outputs)), layout="constrained")
    axes = figure.subplots(len(outputs), sharex=True, squeeze=False)[:, 0]
    for ax, output in zip(axes, outputs, strict=True):
        _draw_output(ax, comparison, output)
        ax.set_ylabel(check_text("labels", texts.get(output, output)))
    axes[0].legend(loc="upper right")
    axes[-1].set_xlabel("time [s]")
    return figure


def _draw_output(ax: Axes, comparison: Comparison, output: str) -> None:
    labels = ("measured", "simulated")
    for measured, simulated in zip(comparison.trajectories, comparison.simulated, strict=True):
        points = measured.outputs[output]
        ax.plot(measured.time, points, ".", ms=3, color="0.6", label=labels[0])
        ax.plot(measured.time, simulated[output], "-", lw=1.2, color="#0072b2", label=labels[1])
        labels = ("", "")
    ax.grid(alpha=0.3)
