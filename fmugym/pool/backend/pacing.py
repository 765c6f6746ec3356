"""Steps in real time: their options and their schedule."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from fmugym.checks import check_number
from fmugym.pool.backend.clocks import Clock, RealClock
from fmugym.pool.base import FloatArray, MaskArray

__all__ = ["Paced", "TickSchedule"]

_TOLERANCE: Final = 0.1
"""How late a step may be without counting as a miss, in periods."""

_HOLD_AFTER: Final = 3
"""Periods without a step after which a backend holds, by default."""


@dataclass(frozen=True)
class Paced:
    """A backend that is stepped in real time.

    Each step waits for its tick, one time step after the last tick. Pacing is elastic: a late step
    shifts all ticks that follow.

    Args:
        backend: One backend, a sequence, or a function; see ``BackendPool``.
        clock: Tells the time; by default the machine's clock.
        hold_after: Time without a step after which a backend is asked to ``hold``, and asked again
            each time it has passed once more, in s. By default three time steps.

    Raises:
        ConfigError: If ``hold_after`` is not positive.
    """

    backend: Any
    clock: Clock = field(default_factory=RealClock)
    hold_after: float | None = None

    def __post_init__(self) -> None:
        if self.hold_after is not None:
            number = check_number(
                "hold_after", self.hold_after, positive=True, may_be_infinite=True
            )
            object.__setattr__(self, "hold_after", number)

    def time_until_hold(self, period: float) -> float:
        """Return ``hold_after`` in s, or its default for a time step in s."""
        return _HOLD_AFTER * period if self.hold_after is None else self.hold_after


class TickSchedule:
    """The ticks of N backends that are stepped together.

    Args:
        period: Time from one tick to the next, in s.
        clock: Tells the time.
        count: N.

    Attributes:
        misses: How many steps of this episode were late by more than a tenth of the period,
            shape (N,).
        worst: The largest lateness in this episode, in s, shape (N,).
    """

    def __init__(self, period: float, clock: Clock, count: int) -> None:
        self._period, self._clock = period, clock
        self._due = np.zeros(count)
        self.misses = np.zeros(count, np.int64)
        self.worst: FloatArray = np.zeros(count)

    def start(self, chosen: MaskArray) -> None:
        """Begin an episode of some backends; their first tick is one period from now."""
        self._due[chosen] = self._clock.time() + self._period
        self.misses[chosen] = 0
        self.worst[chosen] = 0.0

    def wait(self, chosen: MaskArray) -> None:
        """Wait for the next tick of some backends, at least one; return at once if it is over."""
        tick = float(self._due[chosen].max())
        self._clock.sleep(tick - self._clock.time())
        now = self._clock.time()
        tolerance = _TOLERANCE * self._period
        late = np.where(chosen, now - self._due, 0.0)
        self.misses += late > tolerance
        np.maximum(self.worst, late, out=self.worst)
        self._due[chosen] = (now if now > tick + tolerance else tick) + self._period
