"""The memory watchdog: FMUs that leak at every reset are freed and made anew now and then."""

from __future__ import annotations

import functools
import logging
import os
import sys
from collections.abc import Callable
from typing import Final, ParamSpec, TypeVar

from fmugym.archive.bundled import is_bundled
from fmugym.archive.fmu import LoadableFMU
from fmugym.pool.base import PoolSpec
from fmugym.pool.health import Column, HealthArray

__all__ = [
    "LeakWatch",
    "ProcessGrowth",
    "memory_is_known",
    "resident_bytes",
    "watch_leaks",
]

_FIRST_RESETS: Final = 4
"""Of each instance; what they take is no leak: FMUs allocate, and initial states are kept."""

_PAGE_SIZE: Final = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 0

P = ParamSpec("P")
R = TypeVar("R")


def memory_is_known() -> bool:
    """Whether this system tells how much memory a process takes."""
    return sys.platform != "win32"


def resident_bytes() -> int:
    """The memory that this process takes; not on Linux the most that it has ever taken."""
    if sys.platform == "linux":
        with open("/proc/self/statm", "rb", buffering=0) as file:
            return int(file.read(80).split()[1]) * _PAGE_SIZE
    import resource  # not on Windows

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


class LeakWatch:
    """Adds up what resets take, and has instances recycled before it is too much.

    Memory that is freed seldom goes back to the system: what is allocated next is put there. So
    once it is known how many resets leak as much as the limit, instances are recycled after as
    many. If memory grows as much again all the same, that does not help, and is said once.

    Args:
        limit: In bytes.
        counts: Those of the pool's instances.
        recycle: Lets all instances be replaced at their next resets.
        log: Gets the word that it does not help.
        name: What to call the FMU then.

    Attributes:
        growth: What resets have taken, in bytes.
    """

    def __init__(
        self,
        limit: int,
        counts: HealthArray,
        recycle: Callable[[], None],
        log: logging.Logger,
        name: str,
    ) -> None:
        self.growth = 0
        self._limit, self._name, self._log = limit, name, log
        self._resets, self._recycle = counts[:, Column.RESETS], recycle
        self._begin = int(self._resets.sum()) + _FIRST_RESETS * len(counts)
        self._period: int | None = None
        self._due = 0
        self._is_futile = False

    def around(self, function: Callable[P, R]) -> Callable[P, R]:
        """Measure what calls of a function take that resets instances."""

        @functools.wraps(function)
        def measured(*args: P.args, **kwargs: P.kwargs) -> R:
            before = resident_bytes()
            result = function(*args, **kwargs)
            self.note(resident_bytes() - before)
            return result

        return measured

    def note(self, growth: int) -> None:
        """Take notice of what a call has taken, in bytes."""
        resets = int(self._resets.sum())
        if resets <= self._begin:
            return
        self.growth += growth
        if self._is_futile or self.growth < self._limit:
            return
        if self._period is None:
            self._period = resets - self._begin
            self._due = resets
        if self.growth >= 2 * self._limit:
            self._give_up()
        elif resets >= self._due:
            self._due = resets + self._period
            self._recycle()

    def _give_up(self) -> None:
        self._is_futile = True
        self._log.warning(
            "resets of %s have taken %.0f MB of memory, and freeing its instances does not give it "
            "back; isolation='process' does",
            self._name,
            self.growth / 2**20,
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
        """Take notice of so many resets more; returns the growth in bytes."""
        if not memory_is_known():
            return 0
        self._first -= resets
        if self._base is None and self._first <= 0:
            self._base = resident_bytes()
        return 0 if self._base is None else resident_bytes() - self._base


def watch_leaks(
    fmu: LoadableFMU,
    spec: PoolSpec,
    counts: HealthArray,
    recycle: Callable[[], None],
    log: logging.Logger,
) -> LeakWatch | None:
    """Make the watch of a pool, or None where there is nothing to be watched: for bundled FMUs too.

    Args:
        fmu: The FMU.
        spec: Has the limit.
        counts: See ``LeakWatch``.
        recycle: See ``LeakWatch``.
        log: See ``LeakWatch``.
    """
    if spec.leak_limit is None or not memory_is_known() or is_bundled(fmu.path):
        return None
    return LeakWatch(spec.leak_limit, counts, recycle, log, fmu.path.name)
