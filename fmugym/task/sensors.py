"""Sensors and actuators: delay, bias, noise, limits, and lost samples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.environment.distributions import Normal, is_distribution
from fmugym.expressions.functions import chance, clip, noise
from fmugym.expressions.graph import Graph, Value, where
from fmugym.task.task_entries import Entry
from fmugym.task.task_keys import DEVICE

__all__ = ["IDEAL", "NOISE", "Device", "chance_in", "first_step", "noise_in", "read_device"]

NOISE: Final = "noise key"
"""The episode variable from which everything random that is no draw of a reset follows."""

_CHANNELS_OF_BIAS: Final = 40_000
_CHANNELS_OF_DROP_OUT: Final = 50_000


@dataclass(frozen=True)
class Device:
    """A sensor or an actuator; numbers are in the unit of the task.

    Attributes:
        delay: By how many seconds it is late.
        bias: Added bias: a number, or a distribution of one number in each episode.
        noise: The standard deviation of what it adds in each step.
        saturation: The lowest and highest value that it gives; None for no limit.
        quantum: It gives multiples of this; 0 for any value.
        rate: The largest change in a second; infinite for no limit.
        drop_out: The probability that it gives no new value in a step.
        substitute: Value of a lost sample; None for the value before.
    """

    delay: float = 0.0
    bias: Any = 0.0
    noise: float = 0.0
    saturation: tuple[float, float] | None = None
    quantum: float = 0.0
    rate: float = math.inf
    drop_out: float = 0.0
    substitute: float | None = None

    @property
    def is_ideal(self) -> bool:
        """Whether it changes nothing."""
        return self == IDEAL

    @property
    def is_random(self) -> bool:
        """Whether it needs the key of noise."""
        return bool(self.noise or self.drop_out or is_distribution(self.bias))

    @property
    def remembers(self) -> bool:
        """Whether the present value depends on the value before."""
        return self.rate < math.inf or self.drop_out > 0

    def distorted(self, value: Value, count: Value, channel: int) -> Value:
        """A value with bias, noise, saturation and quantization.

        Args:
            value: The true value.
            count: The number of the step.
            channel: The number of the device, from which what is random follows.
        """
        if is_distribution(self.bias):
            value = value + _drawn(self.bias, value.graph, _CHANNELS_OF_BIAS + channel)
        elif self.bias:
            value = value + self.bias
        if self.noise:
            value = value + self.noise * noise_in(count, channel)
        if self.saturation is not None:
            value = clip(value, *self.saturation)
        if self.quantum:
            value = self.quantum * np.rint(value / self.quantum)
        return value

    def following(
        self, value: Value, before: Value, count: Value, channel: int, time_step: float
    ) -> Value:
        """A value with a limited rate and drop-outs.

        Args:
            value: The distorted value.
            before: The value that was given in the step before.
            count: As for ``distorted``.
            channel: As for ``distorted``.
            time_step: Length of a step in seconds.
        """
        if self.rate < math.inf:
            most = self.rate * time_step
            value = clip(value, before - most, before + most)
        if self.drop_out:
            is_lost = chance_in(count, _CHANNELS_OF_DROP_OUT + channel) < self.drop_out
            value = where(is_lost, before if self.substitute is None else self.substitute, value)
        return value


IDEAL: Final = Device()


def noise_in(count: Value, channel: int) -> Value:
    """A number of the standard normal distribution for each step; see ``functions.noise``."""
    value: Value = noise(Value.read(count.graph, "variables", NOISE), count, channel)
    return value


def chance_in(count: Value, channel: int) -> Value:
    """A number from 0 to 1 for each step, all as likely; see ``functions.noise``."""
    value: Value = chance(Value.read(count.graph, "variables", NOISE), count, channel)
    return value


def first_step(graph: Graph) -> Value:
    """Number 0 in each step, for random values that last for an episode."""
    return Value.read(graph, "step_count") * 0


def _drawn(distribution: Any, graph: Graph, channel: int) -> Value:
    """A number that is drawn once in an episode, without the generator of resets."""
    if isinstance(distribution, Normal):
        return distribution.mean + distribution.std * noise_in(first_step(graph), channel)
    low: float = distribution.low
    width: float = distribution.high - low
    return low + width * chance_in(first_step(graph), channel)


def read_device(entry: Entry) -> Device:
    """Read the keys of a sensor or an actuator from the table of a variable."""
    given = {key: one for key, one in (entry.value or {}).items() if key in DEVICE}
    drop_out = given.pop("drop_out", None)
    if drop_out is not None:
        given |= {"drop_out": drop_out.get("probability", 0.0), "substitute": drop_out.get("value")}
    return Device(**given)
