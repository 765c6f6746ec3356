"""The leak watch: FMUs that leak are freed and made anew now and then.

The watch looks at the memory of the process, at some of the calls that reset instances. It cannot
know who has taken memory, the FMU or the caller. So it finds out: when the process has grown by the
limit, all instances are replaced by new ones at their next resets, and the watch measures how much
of the heap that frees.

* If it frees much, the FMU leaks. From then on the instances are replaced as often as they leak as
  much as the limit.
* If it frees little, the growth is the caller's, or the FMU does not give it back. The process may
  then grow twice as much before the next attempt. The watch also measures what the next resets
  allocate. If that explains the growth, the log says so once.

Steps cost nothing: what they leak is seen at the next reset.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from typing import Final, ParamSpec, TypeVar

from fmugym.archive.loadable import LoadableFMU
from fmugym.pool.base import PoolSpec
from fmugym.pool.extension import passes_refusals
from fmugym.pool.health import Column, HealthArray
from fmugym.pool.memory import grown_bytes, heap_bytes, heap_is_known, memory_is_known

__all__ = ["LeakWatch", "ProcessGrowth", "watch_leaks"]

_FIRST_RESETS: Final = 4
"""Of each instance; what they take is no leak: FMUs allocate, and initial states are kept."""

_LONGEST_INTERVAL: Final = 16
"""Calls from one look at the memory to the next; fewer while it grows fast."""

_FAST: Final = 1 / 32
"""Share of the limit; growth by more from one look to the next is fast."""

_REPLACING_CALLS: Final = 16
"""Calls that replace instances, for a measurement of what that frees."""

_PLAIN_CALLS: Final = 32
"""Calls that replace none, for a measurement of what they allocate."""

_TOLERANCE: Final = 1 / 8
"""Share of what a reset allocates; two measurements of it may differ by that much."""

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


class _Measurement:
    """What some calls allocate.

    Args:
        resets: The total of all resets.
        counted: The total of what concerns the measurement; calls without it are left out.
        calls: It is done after so many calls.
        count: Or when so much has been counted.
        most_resets: Or after so many resets of whatever kind.
        growth: That of the process, for which the measurement is made.

    Attributes:
        allocated: Bytes.
        growth: As given.
    """

    def __init__(
        self,
        resets: _Total,
        counted: _Total,
        growth: int,
        calls: int,
        count: float = math.inf,
        most_resets: float = math.inf,
    ) -> None:
        self.allocated, self.growth = 0, growth
        self._resets, self._counted, self._begin = resets, counted, counted.read()
        self._calls_left, self._enough = calls, count
        self._deadline = resets.read() + most_resets

    @passes_refusals
    def around(self, call: Callable[[], R]) -> R:
        """Measure a call, and keep it if it has counted anything."""
        before, counted = heap_bytes(), self._counted.read()
        result = call()
        if self._counted.read() > counted:
            self.allocated += heap_bytes() - before
            self._calls_left -= 1
        return result

    @property
    def count(self) -> int:
        """How much has been counted."""
        return self._counted.read() - self._begin

    @property
    def is_done(self) -> bool:
        """Whether it is enough."""
        if self._calls_left <= 0 or self.count >= self._enough:
            return True
        return self._resets.read() >= self._deadline

    @property
    def each(self) -> float:
        """Bytes that were allocated for each that was counted."""
        return self.allocated / max(1, self.count)


class LeakWatch:
    """Finds out whether an FMU leaks, and has its instances recycled if so.

    Args:
        limit: Bytes that the FMU may leak.
        counts: Those of the pool's instances.
        recycle: Lets all instances be replaced at their next resets.
        log: Is told if that does not help.
        name: What to call the FMU then.

    Attributes:
        has_snapshots: Whether the caller has saved states of instances. They go with their
            instances. So no instance is replaced then unless resets are known to leak.
    """

    def __init__(
        self,
        limit: int,
        counts: HealthArray,
        recycle: Callable[[], None],
        log: logging.Logger,
        name: str,
    ) -> None:
        self.has_snapshots = False
        self._limit, self._name, self._log, self._recycle = limit, name, log, recycle
        self._num_instances = len(counts)
        self._resets = _Total(counts, Column.RESETS)
        self._recyclings = _Total(counts, Column.RECYCLINGS)
        self._first: int | None = None  # bytes after the first resets
        self._base = self._latest = 0  # bytes where growth starts, and at the last look
        self._allowance = limit  # growth that does not call for an attempt
        self._mark = 4 * limit  # growth since the first resets that calls for a measurement
        self._rate = 0.0  # bytes per reset that recycling gives back
        self._since = self._num_instances  # resets when the present instances had begun
        self._until = 0  # resets until the last attempt
        self._interval = self._calls_left = 1
        self._replacing: _Measurement | None = None
        self._plain: _Measurement | None = None
        self._is_said = False

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

    def call(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call a function that resets instances, and watch it."""
        left = self._calls_left = self._calls_left - 1
        if left > 0:
            return function(*args, **kwargs)
        return self._look_around(function, *args, **kwargs)

    @passes_refusals
    def _look_around(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function, and look at the memory."""
        measurement = self._replacing or self._plain
        if measurement is None:
            result = function(*args, **kwargs)
            self._look(self._resets.read())
        else:
            result = measurement.around(functools.partial(function, *args, **kwargs))
            if measurement.is_done:
                self._take(measurement)
        return result

    def _look(self, resets: int) -> None:
        """Look at the memory, and not again for some calls."""
        now = grown_bytes()
        if self._first is None:
            if resets > _FIRST_RESETS * self._num_instances:
                self._first = self._base = self._latest = now
            return
        is_fast = now - self._latest > _FAST * self._limit
        self._interval = 1 if is_fast else min(2 * self._interval, _LONGEST_INTERVAL)
        self._calls_left = self._interval
        self._latest = now
        if heap_is_known():
            self._base = min(self._base, now)
        growth = now - self._base
        leaked = self._rate * (resets - self._since)
        if leaked >= self._limit or (growth >= self._allowance and not self.has_snapshots):
            self._attempt(growth)
        elif growth >= self._allowance:
            self._allowance = 2 * growth
            self._listen(growth)

    def _attempt(self, growth: int) -> None:
        """Recycle the instances and measure what that frees."""
        self._calls_left, self._until = 0, self._resets.read()
        self._replacing = _Measurement(
            *(self._resets, self._recyclings, growth, _REPLACING_CALLS),
            count=self._num_instances,
            most_resets=_FIRST_RESETS * self._num_instances,
        )
        self._recycle()

    def _listen(self, growth: int) -> None:
        """Measure what resets allocate."""
        self._calls_left = 0
        self._mark = 2 * max(self._mark, self.growth)
        self._plain = _Measurement(self._resets, self._resets, growth, _PLAIN_CALLS)

    def _take(self, measurement: _Measurement) -> None:
        """Take over a measurement that is done."""
        if measurement is self._replacing:
            self._replacing = None
            self._judge(measurement.growth, max(0.0, -measurement.each) * self._num_instances)
        else:
            self._plain = None
            self._blame(measurement.each)
        if self._plain is None:
            self._latest = grown_bytes()
            self._begin_anew(measurement.growth)

    def _begin_anew(self, growth: int) -> None:
        """Count growth from here on.

        Where the heap is not known, memory that was freed and that the process keeps does not show.
        Growth begins at the highest level so far then.
        """
        if heap_is_known():
            self._base = self._latest
        elif growth >= self._limit:
            self._base += growth

    def _judge(self, growth: int, freed: float) -> None:
        """Learn from an attempt when the next one is worth it.

        Args:
            growth: That of the process until the attempt, in bytes.
            freed: What recycling all instances frees, in bytes.
        """
        is_due = growth >= self._allowance
        if not heap_is_known() and not (is_due and self._rate):  # then it is taken to help
            freed = self._rate * (self._until - self._since) or float(self._limit)
        self._rate = freed / max(1, self._until - self._since)
        self._since = self._resets.read()
        if is_due:
            helped = freed >= growth / 2
            self._allowance = self._limit if helped else 2 * growth
            if not helped or self.growth >= self._mark:
                self._listen(growth)

    def _blame(self, allocated: float) -> None:
        """Recycle now and then, or say that it does not help, if each reset allocates so much."""
        kept = allocated - self._rate
        lost = kept * self._resets.read()
        if kept < _TOLERANCE * allocated or lost < self._limit:
            return
        if self.has_snapshots and not self._rate:
            self._rate = allocated
        elif not self._is_said:
            self._is_said = True
            self._log.warning(
                "resets of %s have taken %.0f MB of memory, and freeing its instances does not "
                "give it back; isolation='process' does",
                self._name,
                lost / 2**20,
            )


class ProcessGrowth:
    """By how much a process has grown that does nothing but run FMUs.

    Args:
        num_instances: How many.
    """

    def __init__(self, num_instances: int) -> None:
        self._first = _FIRST_RESETS * num_instances
        self._base: int | None = None

    def after(self, resets: int) -> int:
        """Take notice of so many more resets; returns the growth in bytes."""
        if not memory_is_known():
            return 0
        self._first -= resets
        if self._base is None and self._first <= 0:
            self._base = grown_bytes()
        return 0 if self._base is None else grown_bytes() - self._base


def watch_leaks(
    fmu: LoadableFMU,
    spec: PoolSpec,
    counts: HealthArray,
    recycle: Callable[[], None],
    log: logging.Logger,
) -> LeakWatch | None:
    """Make the watch of a pool, or None where nothing is watched: bundled FMUs do not leak.

    Args:
        fmu: The FMU.
        spec: Has the limit.
        counts: See ``LeakWatch``.
        recycle: See ``LeakWatch``.
        log: See ``LeakWatch``.
    """
    if spec.leak_limit is None or not memory_is_known() or fmu.bundled:
        return None
    return LeakWatch(spec.leak_limit, counts, recycle, log, fmu.path.name)
