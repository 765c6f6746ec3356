"""Measure one thread and several on a machine whose processors are all busy with other work."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from cart_poles import fmugym_vector, vector_run
from measure import (
    Effort,
    MissingError,
    Run,
    by_turns,
    cpu_rate,
    processors,
    ratio,
    thread_counts,
    wall_rate,
)
from tables import Table, rate, times

__all__ = ["tables"]

SIZE = 1024
HEADER = ["configuration", "steps/s", "steps/CPU-s", "of 1 thread"]
MOST_SECONDS = 120
BURN = f"import time\nend = time.time() + {MOST_SECONDS}\nwhile time.time() < end: pass"
"""It ends by itself, in case nobody ends it."""


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    title = f"Busy machine: {SIZE:,} environments beside {processors()} processes that never rest"
    table = Table(title, HEADER)
    with ExitStack() as stack:
        try:
            runs = {text: _run(stack, count) for count, text in thread_counts().items()}
        except MissingError as reason:
            table.rows.append([str(reason), "", "", ""])
            return [table]
        with all_processors_busy():
            samples = by_turns(runs, effort)
    for text, own in samples.items():
        wall, cpu, compared = wall_rate(own), cpu_rate(own), ratio(own, samples["1 thread"])
        table.rows.append([f"fmugym, {text}", rate(wall), rate(cpu), times(compared)])
        data = {"configuration": text, "steps_per_s": wall, "steps_per_cpu_s": cpu}
        table.data.append(data | {"of_1_thread": compared})
    return [table]


def _run(stack: ExitStack, threads: int) -> Run:
    env = fmugym_vector(SIZE, threads=threads)
    stack.callback(env.close)
    return vector_run(env)


@contextmanager
def all_processors_busy() -> Iterator[None]:
    """Keep all processors busy."""
    burning = [subprocess.Popen([sys.executable, "-c", BURN]) for _ in range(processors())]
    try:
        yield
    finally:
        for process in burning:
            process.kill()
            process.wait()
