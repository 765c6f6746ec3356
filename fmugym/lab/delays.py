"""Delays of requests on their way to a cell and back."""

from __future__ import annotations

import math
import threading
from typing import Final

import numpy as np

from fmugym.lab.lab_options import Options
from fmugym.pool.backend.clocks import Clock

__all__ = ["Delays"]

_P99: Final = 2.3263478740408408  # the 99th percentile of the standard normal distribution


class Delays:
    """Delays of requests.

    They have a log-normal distribution with the median and the 99th percentile of the options.
    Some requests stall in addition. A request takes effect after its whole delay.

    Args:
        options: The distributions.
        clock: The lab's clock.
        rng: The random generator.
    """

    def __init__(self, options: Options, clock: Clock, rng: np.random.Generator) -> None:
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
