"""Sensors and actuators: how what they give differs from what it should be."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

from fmugym.declared.entries import Entry
from fmugym.declared.format import DEVICE
from fmugym.distributions import Normal, is_distribution

__all__ = ["IDEAL", "NOISE", "Device", "read_device"]

NOISE: Final = "noise key"
"""The episode variable from which everything random that is no draw of a reset follows."""

_CHANNELS_OF_BIAS: Final = 40_000
_CHANNELS_OF_DROP_OUT: Final = 50_000


@dataclass(frozen=True)
class Device:
    """A sensor or an actuator; numbers are in the unit of the task.

    Attributes:
        delay: By how many seconds it is late.
        bias: What it adds: a number, or a distribution of one number in each episode.
        noise: The standard deviation of what it adds in each step.
        saturation: The lowest and highest value that it gives; None for no limit.
        quantum: It gives multiples of this; 0 for any value.
        rate: The largest change in a second; infinite for no limit.
        drop_out: The probability that it gives no new value in a step.
        substitute: What it gives then; None for the value before.
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
        """Whether what it gives depends on what it gave before."""
        return self.rate < math.inf or self.drop_out > 0

    def distorted(self, code: str, count: str, channel: int) -> str:
        """Code for a value with bias, noise, saturation and quantization.

        Args:
            code: Code for the true value.
            count: Code for the number of the step.
            channel: The number of the device, from which what is random follows.
        """
        if is_distribution(self.bias):
            code = f"({code} + {_drawn(self.bias, _CHANNELS_OF_BIAS + channel)})"
        elif self.bias:
            code = f"({code} + {self.bias!r})"
        if self.noise:
            noise = f"noise(env.variables[{NOISE!r}], {count}, {channel})"
            code = f"({code} + {self.noise!r} * {noise})"
        if self.saturation is not None:
            code = f"fn_clip({code}, {self.saturation[0]!r}, {self.saturation[1]!r})"
        if self.quantum:
            code = f"({self.quantum!r} * fn_round(({code} / {self.quantum!r})))"
        return code

    def following(self, code: str, before: str, count: str, channel: int, time_step: float) -> str:
        """Code for a value with a limited rate and drop-outs.

        Args:
            code: Code for the distorted value.
            before: Code for the value that was given in the step before.
            count: As for ``distorted``.
            channel: As for ``distorted``.
            time_step: Length of a step in seconds.
        """
        if self.rate < math.inf:
            most = self.rate * time_step
            code = f"fn_clip({code}, ({before} - {most!r}), ({before} + {most!r}))"
        if self.drop_out:
            channel += _CHANNELS_OF_DROP_OUT
            chance = f"chance(env.variables[{NOISE!r}], {count}, {channel})"
            held = before if self.substitute is None else repr(self.substitute)
            code = f"where(({chance} < {self.drop_out!r}), {held}, {code})"
        return code


IDEAL: Final = Device()


def _drawn(distribution: Any, channel: int) -> str:
    """Code for a number that is drawn once in an episode, without the generator of resets."""
    arguments = f"(env.variables[{NOISE!r}], (env.step_count * 0), {channel})"
    if isinstance(distribution, Normal):
        return f"({distribution.mean!r} + {distribution.std!r} * noise{arguments})"
    low, width = distribution.low, distribution.high - distribution.low
    return f"({low!r} + {width!r} * chance{arguments})"


def read_device(entry: Entry) -> Device:
    """Read the keys of a sensor or an actuator from the table of a variable."""
    given = {key: one for key, one in (entry.value or {}).items() if key in DEVICE}
    drop_out = given.pop("drop_out", None)
    if drop_out is not None:
        given |= {"drop_out": drop_out["probability"], "substitute": drop_out.get("value")}
    return Device(**given)
