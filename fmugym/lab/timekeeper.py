"""The lab's view of its clock, and the delay of requests on their way to the cell and back."""

from __future__ import annotations

import math
import threading
from typing import Final

import numpy as np

from fmugym.checks import check_number
from fmugym.errors import ConfigError, shown
from fmugym.lab.data import LabError, as_lab_error
from fmugym.lab.presets import Options
from fmugym.pool.backend.clocks import Clock
from fmugym.signals import ordinary

__all__ = ["Delays", "Timekeeper"]

_MOST_IDLE_WAITS: Final = 1000
_P99: Final = 2.3263478740408408  # the 99th percentile of the standard normal distribution


class Timekeeper:
    """Reads a clock. Every time is a finite number, and every failure a `LabError`.

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


class Delays:
    """Delays requests on their way.

    Delays have a log-normal distribution with the median and the 99th percentile of the options.
    Some requests stall in addition. A request takes effect after its whole delay.

    Args:
        options: The distributions of the delays.
        clock: The clock that requests wait on.
        rng: The random generator of the delays.
    """

    def __init__(self, options: Options, clock: Timekeeper, rng: np.random.Generator) -> None:
        self._options, self._clock, self._rng = options, clock, rng
        self._drawing = threading.Lock()

    def wait_for_getter(self) -> None:
        """Wait as long as a getter takes."""
        self._wait(self._options.get_time)

    def wait_for_setter(self) -> None:
        """Wait as long as any other request takes."""
        self._wait(self._options.set_time)

    def _wait(self, quantiles: tuple[float, float]) -> None:
        if quantiles[0] > 0.0:
            arrival = self._clock.time() + self._draw(*quantiles)
            self._clock.sleep(arrival - self._clock.time())

    def _draw(self, median: float, p99: float) -> float:
        options = self._options
        with self._drawing:
            spread = math.log(p99 / median) / _P99
            duration = median * math.exp(spread * self._rng.standard_normal())
            if self._rng.random() < options.stall_share:
                duration += self._rng.uniform(options.shortest_stall, options.longest_stall)
        return float(duration)
