"""Logged trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError
from fmugym.pool.base import FloatArray, MaskArray

__all__ = ["Trajectory", "is_repeat"]

LONGEST_REPEAT = 5
"""Repeats in a row above which a plant is taken for one at rest, not for a stale sample."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """What was logged of one experiment, or of a part of it.

    Attributes:
        time: Sampling instants in seconds, increasing, at any distances; shape (n,).
        outputs: The measured values by the name of the FMU's output, each of shape (n,).
        inputs: The inputs by name, each of shape (n,), or a number where one is constant. Each
            value holds until the next sample.
        label: What the trajectory is called in texts and plots.
    """

    time: FloatArray
    outputs: Mapping[str, FloatArray]
    inputs: Mapping[str, FloatArray] = field(default_factory=dict)
    label: str = ""

    def __post_init__(self) -> None:
        time = _samples("time", self.time, None)
        if len(time) < 2 or not (np.diff(time) > 0).all():
            raise ConfigError("time must have at least two samples and increase")
        if not self.outputs:
            raise ConfigError("a trajectory needs at least one measured output")
        count = len(time)
        outputs = {name: _samples(name, values, count) for name, values in self.outputs.items()}
        inputs = {name: _samples(name, values, count) for name, values in self.inputs.items()}
        for key, value in (("time", time), ("outputs", outputs), ("inputs", inputs)):
            object.__setattr__(self, key, value)

    def __len__(self) -> int:
        return len(self.time)

    def select(self, chosen: MaskArray | slice) -> Trajectory:
        """Return a trajectory of some of the samples, as numpy indexing chooses them."""
        outputs = {name: values[chosen] for name, values in self.outputs.items()}
        inputs = {name: values[chosen] for name, values in self.inputs.items()}
        return Trajectory(self.time[chosen], outputs, inputs, self.label)

    def between(self, start: float, end: float) -> Trajectory:
        """Return the samples with ``start <= time < end``, in seconds."""
        chosen = (self.time >= start) & (self.time < end)
        if chosen.sum() < 2:
            raise ConfigError(
                f"there are fewer than two samples between {start:g} and {end:g} s; "
                f"the trajectory has {self.time[0]:g} to {self.time[-1]:g} s"
            )
        return self.select(chosen)

    def windows(self, length: float) -> list[Trajectory]:
        """Cut the trajectory into consecutive windows.

        Args:
            length: Of each window in seconds.

        Returns:
            The windows that are full; the rest at the end is left out.
        """
        start, period = self.time[0], (self.time[-1] - self.time[0]) / (len(self) - 1)
        count = int((self.time[-1] - start + period) / length + 1e-9)
        return [self.between(start + i * length, start + (i + 1) * length) for i in range(count)]

    def without_repeats(self) -> Trajectory:
        """Leave out stale samples: those whose outputs are all the same as just before.

        More than five repeats in a row are kept, as they tell of a plant at rest.
        """
        return self.select(~is_repeat(np.stack(list(self.outputs.values()))))


def is_repeat(signals: FloatArray) -> MaskArray:
    """Find the stale samples of signals that were logged together.

    Args:
        signals: Shape (k, n).

    Returns:
        Which samples repeat the one before in all k signals, shape (n,); runs of more than five
        repeats are no repeats.
    """
    same = np.concatenate([[False], (np.diff(signals, axis=1) == 0).all(axis=0)])
    run = np.cumsum(~same) - 1
    repeats = np.bincount(run) - 1
    found: MaskArray = same & (repeats[run] <= LONGEST_REPEAT)
    return found


def _samples(name: str, values: npt.ArrayLike, count: int | None) -> FloatArray:
    """Check one signal and copy it; a number is a constant signal."""
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name!r} of a trajectory must be numbers") from None
    if array.ndim == 0 and count is not None:
        array = np.full(count, array)
    if array.ndim != 1 or count not in (None, len(array)):
        wanted = "(n,)" if count is None else f"({count},)"
        raise ConfigError(f"{name!r} of a trajectory must have the shape {wanted}: {array.shape}")
    if not np.isfinite(array).all():
        raise ConfigError(f"{name!r} of a trajectory must be finite")
    return array


def common_names(trajectories: Sequence[Trajectory]) -> tuple[list[str], list[str]]:
    """Return the names of the outputs and inputs, which all trajectories must share."""
    if not trajectories:
        raise ConfigError("expected at least one trajectory")
    outputs, inputs = list(trajectories[0].outputs), list(trajectories[0].inputs)
    for other in trajectories:
        if set(other.outputs) != set(outputs) or set(other.inputs) != set(inputs):
            raise ConfigError("all trajectories must have the same outputs and the same inputs")
    return outputs, inputs
