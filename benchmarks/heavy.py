"""Measure the share of the processors that FMUs with long steps get."""

from __future__ import annotations

import itertools
import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from busy import BusyEnv
from c_fmus import build_busy
from cart_poles import require_native_pool
from measure import (
    Effort,
    MissingError,
    Run,
    Sample,
    Stopwatch,
    by_turns,
    cpu_rate,
    thread_counts,
    wall_rate,
)
from tables import Table, duration, share

import fmugym

__all__ = ["tables"]

TITLE = (
    "64 FMUs with long steps: processor time in the FMUs / (wall-clock time x threads),\n"
    "and / all processor time"
)
SIZE = 64
MEANS = (10.0, 100.0, 1000.0)
"""Times of a step in us."""
KINDS = {
    "constant": {"sigma": 0.0},
    "heavy-tailed": {"sigma": 1.5},
    "1 % 100 times": {"sigma": 0.0, "rare": 0.01},
}
"""Distributions of the time of a step.

With a sigma of 1.5, the median of the longest of 64 lognormal times is 12 times their mean. Stiff
models with events are like the third: nearly all steps are short, and a few very long.
"""


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    threads = thread_counts()
    texts = [text for name in threads.values() for text in (f"{name}, wall", "CPU")]
    table = Table(TITLE, ["time of a step", "distribution", *texts])
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        try:
            samples = by_turns(_runs(stack, Path(folder), effort), effort)
        except MissingError as reason:
            table.rows.append([str(reason), *[""] * (len(table.header) - 1)])
            return [table]
    for mean, kind in itertools.product(MEANS, KINDS):
        _add(table, mean, kind, samples)
    return [table]


def _key(mean: float, kind: str, threads: int) -> str:
    return f"{mean} {kind} {threads}"


def _runs(stack: ExitStack, folder: Path, effort: Effort) -> dict[str, Run]:
    require_native_pool()
    path = build_busy(folder)
    rows = itertools.product(MEANS, KINDS, thread_counts())
    return {_key(*row): _run(stack, path, *row) for row in rows}


def _run(stack: ExitStack, path: Path, mean: float, kind: str, threads: int) -> Run:
    """Count the seconds in which FMUs were busy."""
    options = {"mean": mean, "rare_time": 100.0 * mean, **KINDS[kind]}
    env = fmugym.FMUVectorEnv(lambda: BusyEnv(path, **options), SIZE, threads=threads)
    stack.callback(env.close)
    actions = np.zeros(SIZE, np.int64)

    def run(seconds: float) -> Sample:
        env.reset(seed=0)
        watch, observations = Stopwatch(), None
        while watch.wall < seconds:
            watch.start()
            observations = env.step(actions)[0]
            watch.stop()
        return watch.sample(1e-6 * float(np.sum(observations, dtype=np.float64)))

    return run


def _add(table: Table, mean: float, kind: str, samples: dict[str, list[Sample]]) -> None:
    cells, data = [], {"step_us": mean, "distribution": kind}
    for threads in thread_counts():
        own = samples[_key(mean, kind, threads)]
        wall, cpu = wall_rate(own) / threads, cpu_rate(own)
        cells += [share(wall), share(cpu)]
        data |= {f"wall_share_{threads}_threads": wall, f"cpu_share_{threads}_threads": cpu}
    table.rows.append([duration(1e-6 * mean), kind, *cells])
    table.data.append(data)
