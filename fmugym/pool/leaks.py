"""The leak watch: it tells once that resets of an FMU do not give memory back.

The watch looks at the memory of the process, at some of the calls that reset instances. It cannot
know who has taken memory, the FMU or the caller. So once the process has grown by the limit, it
measures what some of these calls allocate. If that makes up the limit in all resets, the log says
so. If not, the process may grow twice as much before the next measurement.

Steps cost nothing. Worker processes that grow are replaced; see ``fmugym.pool.process.pool``.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from typing import Final, ParamSpec, TypeVar

from fmugym.archive.fmu import FMU
from fmugym.pool.base import PoolSpec
from fmugym.pool.extension import passes_refusals
from fmugym.pool.health import Column, HealthArray
from fmugym.pool.process_memory import grown_bytes, heap_bytes, memory_is_known

__all__ = ["LeakWatch", "watch_leaks"]

_FIRST_RESETS: Final = 4
"""Of each instance; what they take is no leak: FMUs allocate, and initial states are kept."""

_LONGEST_INTERVAL: Final = 16
"""Calls from one look at the memory to the next."""

_MEASURED_CALLS: Final = 32
"""Calls of a measurement."""

P = ParamSpec("P")
R = TypeVar("R")


class _Total:
    """The sum of a column of counts, which goes on when the counts are set to zero."""

    def __init__(self, counts: HealthArray, column: int) -> None:
        self._column = counts[:, column]
        self._last = int(self._column.sum())
        self._total = 0

    def read(self) -> int:
        now = int(self._column.sum())
        self._total += now - self._last if now >= self._last else now
        self._last = now
        return self._total


class LeakWatch:
    """Finds out whether resets of an FMU leak memory, and says so once.

    Args:
        limit: Bytes that they may take.
        counts: Those of the pool's instances.
        log: Is told.
        name: What to call the FMU then.
    """

    def __init__(self, limit: int, counts: HealthArray, log: logging.Logger, name: str) -> None:
        self._limit, self._name, self._log = limit, name, log
        self._num_instances = len(counts)
        self._resets = _Total(counts, Column.RESETS)
        self._first: int | None = None  # bytes after the first resets
        self._allowance: float = limit  # growth that does not call for a measurement
        self._interval = self._calls_left = 1
        self._to_measure = 0  # calls
        self._allocated = self._measured = 0  # bytes, and resets

    @property
    def growth(self) -> int:
        """By how many bytes the process has grown since the first resets."""
        return 0 if self._first is None else max(0, grown_bytes() - self._first)

    def around(self, function: Callable[P, R]) -> Callable[P, R]:
        """Watch the calls of a function that resets instances."""

        @functools.wraps(function)
        @passes_refusals
        def watched(*args: P.args, **kwargs: P.kwargs) -> R:
            left = self._calls_left = self._calls_left - 1
            if left > 0:
                return function(*args, **kwargs)
            return self._look_around(function, *args, **kwargs)

        return watched

    @passes_refusals
    def _look_around(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function, and look at the memory."""
        if not self._to_measure:
            result = function(*args, **kwargs)
            self._look()
            return result
        before, resets = heap_bytes(), self._resets.read()
        result = function(*args, **kwargs)
        self._measure(heap_bytes() - before, self._resets.read() - resets)
        return result

    def _look(self) -> None:
        """Look at the memory, and not again for some calls."""
        self._calls_left = self._interval = min(2 * self._interval, _LONGEST_INTERVAL)
        if self._first is None:
            if self._resets.read() > _FIRST_RESETS * self._num_instances:
                self._first = grown_bytes()
        elif self.growth >= self._allowance:
            self._calls_left, self._to_measure = 0, _MEASURED_CALLS
            self._allocated = self._measured = 0

    def _measure(self, allocated: int, resets: int) -> None:
        """Note what a call has allocated; those that reset nothing are left out."""
        if not resets:
            return
        self._allocated += allocated
        self._measured += resets
        self._to_measure -= 1
        if not self._to_measure:
            self._judge(self._allocated / self._measured * self._resets.read())

    def _judge(self, lost: float) -> None:
        """Say it, if resets have taken so many bytes."""
        self._allowance = 2 * self.growth
        if lost >= self._limit:
            self._allowance = math.inf
            self._log.warning(
                "resets of %s have taken %.0f MB of memory; isolation='process' gives it back",
                self._name,
                lost / 2**20,
            )


def watch_leaks(
    fmu: FMU,
    spec: PoolSpec,
    counts: HealthArray,
    log: logging.Logger,
) -> LeakWatch | None:
    """Make the watch of a pool, or None where nothing is watched: bundled FMUs do not leak.

    Args:
        fmu: The FMU.
        spec: Has the limit.
        counts: See ``LeakWatch``.
        log: See ``LeakWatch``.
    """
    if spec.leak_limit is None or not memory_is_known() or fmu.bundled:
        return None
    return LeakWatch(spec.leak_limit, counts, log, fmu.path.name)
