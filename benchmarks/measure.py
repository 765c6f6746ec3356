"""Run several configurations by turns, and compute medians and ratios of their rates."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple, TypeVar

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
    """Something that a configuration needs is missing; its row shows the text."""


class Effort(NamedTuple):
    """How long a section may take.

    Attributes:
        rounds: Number of turns of each configuration.
        seconds: Length of a turn.
        quick: Whether to check only that everything works.
    """

    rounds: int
    seconds: float
    quick: bool


class Sample(NamedTuple):
    """The result of one turn.

    Attributes:
        count: Number of steps, or of whatever is counted.
        wall: Wall-clock time in seconds.
        cpu: Processor time of all threads and worker processes in seconds.
    """

    count: float
    wall: float
    cpu: float


Run = Callable[[float], Sample]
"""Works for about the given number of seconds."""


class Stopwatch:
    """Adds up wall-clock and processor time between ``start`` and ``stop``.

    Args:
        workers: Other processes whose time counts, too.

    Attributes:
        wall: In seconds.
        cpu: In seconds.
    """

    def __init__(self, workers: Sequence[int] = ()) -> None:
        self._workers = workers
        self.wall = self.cpu = 0.0

    def start(self) -> None:
        """Start the clocks."""
        self._cpu = cpu_seconds(self._workers)
        self._wall = time.perf_counter()

    def stop(self) -> None:
        """Stop the clocks."""
        self.wall += time.perf_counter() - self._wall
        self.cpu += cpu_seconds(self._workers) - self._cpu

    def sample(self, count: float) -> Sample:
        """Return the sample of the time so far."""
        return Sample(count, self.wall, self.cpu)


def cpu_seconds(workers: Iterable[int]) -> float:
    """Processor time of this process and others; NaN if the system does not report it.

    Linux has a clock for each process, with the number that ``clock_getcpuclockid`` computes.
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
    """One thread, and one per processor, each with its text."""
    count = processors()
    return {1: "1 thread"} | ({count: f"{count} threads"} if count > 1 else {})


def make_runs(
    makers: Mapping[str, Callable[[], Callable[[float], Result]]],
) -> tuple[dict[str, Callable[[float], Result]], dict[str, str]]:
    """Make the runs that can be made.

    Returns:
        The runs, and for each other configuration the reason why there is none.
    """
    runs, missing = {}, {}
    for name, make in makers.items():
        try:
            runs[name] = make()
        except MissingError as reason:
            missing[name] = str(reason)
    return runs, missing


Result = TypeVar("Result")


def by_turns(
    runs: Mapping[str, Callable[[float], Result]], effort: Effort
) -> dict[str, list[Result]]:
    """Give each configuration a turn in every round, after a round to warm up.

    The first in a round is the last in the next, so that none always follows the same one.
    """
    samples: dict[str, list[Result]] = {name: [] for name in runs}
    names = list(runs)
    for index in range(effort.rounds + 1):
        for name in names:
            sample = runs[name](effort.seconds if index else effort.seconds / 4)
            samples[name] += [sample] if index else []
        names = names[1:] + names[:1]
    return samples


def wall_rate(samples: Sequence[Sample]) -> float:
    """Median rate per second of wall-clock time."""
    return statistics.median(sample.count / sample.wall for sample in samples)


def cpu_rate(samples: Sequence[Sample]) -> float:
    """Median rate per second of processor time."""
    return statistics.median(sample.count / max(sample.cpu, 1e-9) for sample in samples)


def ratio(samples: Sequence[Sample], base: Sequence[Sample]) -> float:
    """Median over the rounds of the ratio of two rates, by the wall clock."""
    pairs = zip(samples, base, strict=True)
    return statistics.median(a.count * b.wall / (a.wall * b.count) for a, b in pairs)


def repeated(
    block: Callable[[], object], count: int, prepare: Callable[[], object] | None = None
) -> Run:
    """Call a function until the time is over.

    Args:
        block: The function to measure.
        count: How much one call counts.
        prepare: Called before each call, while the clocks stand still.
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
