"""The pace at which instances are made and initialized, for licences that limit it."""

from __future__ import annotations

import math
import threading
import time

from fmugym.pool.spec import PoolSpec

__all__ = ["Pacer"]


class Pacer:
    """Waits before an instance is made or initialized; ``native/pace.c`` does the same in C.

    Time is divided into slots of ``spec.initialization_interval`` seconds of the monotonic clock,
    which all processes of a machine share. In each slot one call may begin. The workers of a pool
    have the slots in turn, so they keep to the pace together.

    Args:
        spec: Has the interval and the turn.
    """

    def __init__(self, spec: PoolSpec) -> None:
        self._interval, (self._turn, self._turns) = spec.initialization_interval, spec.turn
        self._lock = threading.Lock()
        self._last = -1

    def wait(self) -> None:
        """Wait for the next free slot."""
        if self._interval > 0.0:
            time.sleep(max(0.0, self._claim() * self._interval - time.monotonic()))

    def _claim(self) -> int:
        with self._lock:
            slot = max(self._last + 1, math.ceil(time.monotonic() / self._interval))
            self._last = slot + (self._turn - slot) % self._turns
            return self._last
