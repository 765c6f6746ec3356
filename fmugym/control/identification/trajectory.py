"""Logged trajectories, and their comparison with simulations, in numbers and in a plot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fmugym.checks import Spellings, by_own_names, check_mapping, check_text
from fmugym.errors import ConfigError, shown
from fmugym.pool.pool import FloatArray, MaskArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fmugym.rendering.figures import Figure

__all__ = ["Comparison", "Trajectory", "common_names", "named_as_own", "plot_comparison"]

_LONGEST_REPEAT = 5
"""Longer runs of equal samples are a plant at rest, not stale samples."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The log of one experiment or of a part of it.

    Attributes:
        time: Sampling instants in seconds, increasing, at any intervals; shape (n,).
        outputs: The measured values by the name of the FMU's output, each of shape (n,).
        inputs: The inputs by name, each of shape (n,), or a number for a constant input. Each
            value holds until the next sample.
        label: The name of the trajectory in texts and plots.

    Raises:
        ConfigError: If an array has a wrong shape or is not finite, or the time does not increase.
    """

    time: FloatArray
    outputs: Mapping[str, FloatArray]
    inputs: Mapping[str, FloatArray] = field(default_factory=dict)
    label: str = ""

    def __post_init__(self) -> None:
        time = _samples("time", self.time, None)
        if len(time) < 2 or not (np.diff(time) > 0).all():
            raise ConfigError("time must have at least two samples and increase")
        outputs = _signals("outputs", self.outputs, len(time))
        if not outputs:
            raise ConfigError("a trajectory needs at least one measured output")
        check_text("label", self.label)
        inputs = _signals("inputs", self.inputs, len(time))
        for key, value in (("time", time), ("outputs", outputs), ("inputs", inputs)):
            object.__setattr__(self, key, value)

    def __len__(self) -> int:
        return len(self.time)

    def select(self, chosen: MaskArray | slice) -> Trajectory:
        """Return a trajectory of some of the samples.

        Args:
            chosen: A mask, a slice or an array of indices, as for numpy.

        Raises:
            ConfigError: If this is not an index, or chooses fewer than two samples.
        """
        try:
            rows = np.arange(len(self))[chosen]
        except Exception:  # objects may do anything when numpy looks at them
            raise ConfigError(f"samples cannot be selected by {shown(chosen)}") from None
        outputs = {name: values[rows] for name, values in self.outputs.items()}
        inputs = {name: values[rows] for name, values in self.inputs.items()}
        return Trajectory(self.time[rows], outputs, inputs, self.label)

    def without_repeats(self) -> Trajectory:
        """Drop stale samples, whose outputs all equal the outputs of the sample before.

        More than five repeats in a row stay, because they show a plant at rest.
        """
        signals = np.stack(list(self.outputs.values()))
        same = np.concatenate([[False], (np.diff(signals, axis=1) == 0).all(axis=0)])
        run = np.cumsum(~same) - 1
        repeats = np.bincount(run) - 1
        return self.select(~same | (repeats[run] > _LONGEST_REPEAT))


def common_names(trajectories: Sequence[Trajectory]) -> tuple[list[str], list[str]]:
    """Return the names of the outputs and inputs, which all trajectories must share.

    Raises:
        ConfigError: If something is not a trajectory, there is none, or the names differ.
    """
    first, *others = _checked(trajectories)
    outputs, inputs = list(first.outputs), list(first.inputs)
    for other in others:
        if set(other.outputs) != set(outputs) or set(other.inputs) != set(inputs):
            raise ConfigError("all trajectories must have the same outputs and the same inputs")
    return outputs, inputs


def named_as_own(
    trajectories: Sequence[Trajectory], own_name: Callable[[str], str]
) -> list[Trajectory]:
    """Return the trajectories with the own names of the FMU's variables.

    Args:
        trajectories: They may have names whose letters only look the same.
        own_name: Finds the own name for a given one.

    Raises:
        ConfigError: If something is not a trajectory, there is none, or two names of a trajectory
            stand for the same variable.
    """
    return [
        replace(
            one,
            outputs=by_own_names("the outputs of a trajectory", one.outputs, own_name),
            inputs=by_own_names("the inputs of a trajectory", one.inputs, own_name),
        )
        for one in _checked(trajectories)
    ]


def _checked(trajectories: Any) -> list[Trajectory]:
    try:
        is_list = isinstance(trajectories, Sequence)
        good = is_list and all(isinstance(one, Trajectory) for one in trajectories)
    except Exception:  # the object's own method fails
        good = False
    if not good:
        raise ConfigError(f"expected a list of trajectories, not {shown(trajectories)}")
    if not trajectories:
        raise ConfigError("expected at least one trajectory")
    return list(trajectories)


def _signals(what: str, signals: Any, count: int) -> dict[str, FloatArray]:
    checked = check_mapping(f"{what} of a trajectory", signals)
    return {name: _samples(name, values, count) for name, values in checked.items()}


def _samples(name: str, values: npt.ArrayLike, count: int | None) -> FloatArray:
    """Check and copy one signal; a number is a constant signal."""
    what = f"{shown(name)} of a trajectory"
    try:
        raw = np.asarray(values)
        if raw.dtype.kind not in "biufO":  # numpy would convert texts and complex numbers
            raise TypeError
        array = np.array(raw, np.float64)
    except Exception:  # objects may do anything when numpy looks at them
        raise ConfigError(f"{what} must be numbers, not {shown(values)}") from None
    if not np.isfinite(array).all():
        raise ConfigError(f"{what} must be finite")
    if array.ndim == 0 and count is not None:
        array = np.full(count, array)
    if array.ndim != 1 or count not in (None, len(array)):
        wanted = "(n,)" if count is None else f"({count},)"
        raise ConfigError(f"{what} must have the shape {wanted}, not {array.shape}")
    return array


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
    from fmugym.rendering.figures import Figure

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
