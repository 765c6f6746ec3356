"""Measure memory per instance, growth, and very many instances, each in its own process."""

from __future__ import annotations

import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from cart_poles import fmugym_vector, require_native_pool
from measure import Effort, MissingError
from tables import Table, duration

__all__ = ["tables"]

SIZE = 1024


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    table = Table("Memory, and many instances (of make_vec)", ["figure", "value"])
    try:
        require_native_pool()
        for name, text, value in _figures(effort):
            table.rows.append([name, text])
            table.data.append({"figure": name, "value": value})
    except MissingError as reason:
        table.rows.append(["all", str(reason)])
    return [table]


def _figures(effort: Effort) -> list[tuple[str, str, float]]:
    few, many, most = (1_000, 5_000, 10_000) if effort.quick else (1_000, 20_000, 100_000)
    steps, resets = (100_000, 10_000) if effort.quick else (10_000_000, 1_000_000)
    each = (in_child(resident_with, many) - in_child(resident_with, few)) / (many - few)
    more = in_child(growth, steps, resets)
    made, reset, step = in_child(times_of, most)
    return [
        (f"memory per environment, from {few:,} to {many:,}", f"{each:,.0f} B", each),
        (f"growth over {steps:,} steps", f"{more[0] / 1024:,.0f} kB", more[0]),
        (f"growth over {resets:,} resets", f"{more[1] / 1024:,.0f} kB", more[1]),
        (f"{most:,} environments: to make", duration(made), made),
        (f"{most:,} environments: first reset", duration(reset), reset),
        (f"{most:,} environments: one step of all", duration(step), step),
    ]


def in_child(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function of this module in a new process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def resident() -> int:
    """Resident memory of this process in bytes.

    Raises:
        MissingError: If there is no /proc.
    """
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        raise MissingError("only on Linux") from None
    return pages * os.sysconf("SC_PAGE_SIZE")


def resident_with(num_envs: int) -> int:
    """Memory of this many environments in bytes, after a few steps and two resets."""
    env = fmugym_vector(num_envs)
    for seed in (0, None):
        env.reset(seed=seed)
        _step(env, 50)
    size = resident()
    env.close()
    return size


def _step(env: Any, count: int) -> None:
    pushes = np.random.default_rng(0).integers(0, 2, (16, env.num_envs))
    for index in range(count):
        env.step(pushes[index % 16])


def growth(steps: int, resets: int) -> tuple[int, int]:
    """Growth of memory in bytes over many steps, and over many resets."""
    env = fmugym_vector(SIZE)
    env.reset(seed=0)
    _step(env, 200)
    env.reset()
    before = resident()
    _step(env, steps // SIZE)
    between = resident()
    for _ in range(resets // SIZE):
        env.reset()
    after = resident()
    env.close()
    return between - before, after - between


def times_of(num_envs: int) -> tuple[float, float, float]:
    """Seconds to make, to reset for the first time, and to step once (median of 21)."""
    begin = time.perf_counter()
    env = fmugym_vector(num_envs)
    made = time.perf_counter()
    env.reset(seed=0)
    ready = time.perf_counter()
    actions = env.action_space.sample()
    steps = [_time_of(lambda: env.step(actions)) for _ in range(21)]
    env.close()
    return made - begin, ready - made, statistics.median(steps)


def _time_of(function: Callable[[], object]) -> float:
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin
