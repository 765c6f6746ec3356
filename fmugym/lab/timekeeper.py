"""The lab's view of its clock: every time is a finite number, and every failure a `LabError`."""

from __future__ import annotations

import math
from typing import Final

from fmugym.checks import check_number
from fmugym.errors import ConfigError, shown
from fmugym.lab.lab_error import LabError, as_lab_error
from fmugym.pool.backend.clocks import Clock
from fmugym.signals import ordinary

__all__ = ["Timekeeper"]

_MOST_IDLE_WAITS: Final = 1000


class Timekeeper:
    """Reads and checks a clock.

    Args:
        clock: The clock.

    Attributes:
        opened: The time at the beginning, in s.

    Raises:
        ConfigError: If the object is not a clock, or gives something other than a finite time.
    """

    def __init__(self, clock: Clock) -> None:
        if not all(callable(getattr(clock, name, None)) for name in ("time", "sleep")):
            raise ConfigError(f"clock must have the methods time and sleep: {shown(clock)}")
        self._clock = clock
        self._idle_waits = 0
        try:
            self.opened = self.time()
        except LabError as error:
            raise ConfigError(str(error)) from error.__cause__

    def time(self) -> float:
        """Return the time, in s.

        Raises:
            LabError: If the clock fails, or gives something other than a finite number.
        """
        try:
            now = self._clock.time()
        except ordinary(Exception) as error:
            raise _failure(error) from error
        if type(now) is float and math.isfinite(now):  # the full check takes a while
            return now
        with as_lab_error():
            return check_number("the time of the lab's clock", now)

    def sleep(self, seconds: float) -> None:
        """Wait for some time, in s; a negative time is no wait.

        Raises:
            LabError: If the clock fails.
        """
        try:
            self._clock.sleep(max(0.0, seconds))
        except ordinary(Exception) as error:
            raise _failure(error) from error

    def wait(self, seconds: float) -> None:
        """Wait as one of many waits for an event, in s.

        Raises:
            LabError: If the clock fails, or stands still for many waits.
        """
        before = self.time()
        self.sleep(seconds)
        self._idle_waits = 0 if self.time() > before else self._idle_waits + 1
        if self._idle_waits > _MOST_IDLE_WAITS:
            raise LabError("the lab's clock stands still, so that no cell comes free")


def _failure(error: Exception) -> LabError:
    return LabError(f"the lab's clock failed: {shown(error)}")
