"""Several configurations run by turns, and the medians and ratios of what they do."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

__all__ = [
    "Effort",
    "MissingError",
    "Run",
    "Sample",
    "Stopwatch",
    "by_turns",
    "cpu_rate",
    "make_runs",
    "processors",
    "ratio",
    "repeated",
    "thread_counts",
    "wall_rate",
]


class MissingError(Exception):
    """What a configuration needs is not there; the text is what its row shows."""


class Effort(NamedTuple):
    """How long a section may take.

    Attributes:
        rounds: How often each configuration has its turn.
        seconds: How long a turn lasts.
        quick: Whether only to show that everything works.
    """

    rounds: int
    seconds: float
    quick: bool


class Sample(NamedTuple):
    """What one turn did.

    Attributes:
        count: Steps, or whatever is counted.
        wall: Wall-clock time in seconds.
        cpu: Processor time of all threads and worker processes in seconds.
    """

    count: float
    wall: float
    cpu: float


Run = Callable[[float], Sample]
"""Works for about as many seconds as it is told."""


class Stopwatch:
    """Adds up wall-clock and processor time between ``start`` and ``stop``.

    Args:
        workers: Other processes whose time counts too.

    Attributes:
        wall: In seconds.
        cpu: In seconds.
    """

    def __init__(self, workers: Sequence[int] = ()) -> None:
        self._workers = workers
        self.wall = self.cpu = 0.0

    def start(self) -> None:
        """Begin a stretch."""
        self._cpu = cpu_seconds(self._workers)
        self._wall = time.perf_counter()

    def stop(self) -> None:
        """End it."""
        self.wall += time.perf_counter() - self._wall
        self.cpu += cpu_seconds(self._workers) - self._cpu

    def sample(self, count: float) -> Sample:
        """What was done in the time so far."""
        return Sample(count, self.wall, self.cpu)


def cpu_seconds(workers: Iterable[int]) -> float:
    """Processor time of this process and others, NaN where the system does not tell of those.

    Linux has a clock for each process, numbered as in its ``clock_getcpuclockid``.
    """
    try:
        others = sum(time.clock_gettime(~worker << 3 | 2) for worker in workers)
    except (AttributeError, OSError):
        others = float("nan")
    return time.process_time() + others


def processors() -> int:
    """The number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def thread_counts() -> dict[int, str]:
    """One thread, and one for each processor; with the words for it."""
    count = processors()
    return {1: "1 thread"} | ({count: f"{count} threads"} if count > 1 else {})


def make_runs(makers: Mapping[str, Callable[[], Run]]) -> tuple[dict[str, Run], dict[str, str]]:
    """Make what can be made.

    Returns:
        The runs, and, of the others, why there is none.
    """
    runs, missing = {}, {}
    for name, make in makers.items():
        try:
            runs[name] = make()
        except MissingError as reason:
            missing[name] = str(reason)
    return runs, missing


def by_turns(runs: Mapping[str, Run], effort: Effort) -> dict[str, list[Sample]]:
    """Let each have its turn in every round, after one to get warm.

    Whoever comes first in a round comes last in the next, so that nobody always follows the same.
    """
    samples: dict[str, list[Sample]] = {name: [] for name in runs}
    names = list(runs)
    for index in range(effort.rounds + 1):
        for name in names:
            sample = runs[name](effort.seconds if index else effort.seconds / 4)
            samples[name] += [sample] if index else []
        names = names[1:] + names[:1]
    return samples


def wall_rate(samples: Sequence[Sample]) -> float:
    """Median of what is done in a second."""
    return statistics.median(sample.count / sample.wall for sample in samples)


def cpu_rate(samples: Sequence[Sample]) -> float:
    """Median of what is done in a second of processor time."""
    return statistics.median(sample.count / max(sample.cpu, 1e-9) for sample in samples)


def ratio(samples: Sequence[Sample], base: Sequence[Sample]) -> float:
    """Median over the rounds of how many times as fast as another one it is, by the wall clock."""
    pairs = zip(samples, base, strict=True)
    return statistics.median(a.count * b.wall / (a.wall * b.count) for a, b in pairs)


def repeated(
    block: Callable[[], object], count: int, prepare: Callable[[], object] | None = None
) -> Run:
    """Call a function until the time is over.

    Args:
        block: What is measured.
        count: How much it does.
        prepare: Called before each, while the clock stands still.
    """

    def run(seconds: float) -> Sample:
        watch, done = Stopwatch(), 0
        while watch.wall < seconds:
            if prepare:
                prepare()
            watch.start()
            block()
            watch.stop()
            done += count
        return watch.sample(done)

    return run
