"""Measure a learner that takes as long as its FMUs, in turn with them and at the same time."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from busy import BusyEnv
from c_fmus import build_busy
from cart_poles import require_native_pool
from measure import Effort, Run, Sample, by_turns, cpu_rate, make_runs, ratio, repeated, wall_rate
from tables import Table, rate, times

import fmugym

__all__ = ["tables"]

TITLE = "A learner that takes as long as its 32 FMUs of 100 us a step, each on one thread: steps/s"
HEADER = ["configuration", "steps/s", "steps/CPU-s", "of step"]
SIZE, MEAN = 32, 100.0
TOGETHER, HALVES = "step, then learn", "step_async of two halves in turn"

FREE_TITLE = "What two processors are worth here: products of matrices/s in the same rounds"
FREE_HEADER = ["configuration", "products/s", "of one thread"]
ALONE, AT_ONCE = "one thread", "two threads at once"

FACTORS = np.random.default_rng(0).normal(size=(2, 56, 56)) / 10
"""So small that BLAS multiplies them on one thread: the other processor is for the FMUs."""
PRODUCTS = 200


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        makers: dict[str, Callable[[], Run]] = {
            TOGETHER: lambda: _together(stack, Path(folder)),
            HALVES: lambda: _halves(stack, Path(folder)),
            ALONE: lambda: _products(stack, 1),
            AT_ONCE: lambda: _products(stack, 2),
        }
        runs, missing = make_runs(makers)
        samples = by_turns(runs, effort)
    return [_overlap(samples, missing), _free(samples)]


def _overlap(samples: dict[str, list[Sample]], missing: dict[str, str]) -> Table:
    table = Table(TITLE, HEADER)
    for name in [name for name in (TOGETHER, HALVES) if name in samples]:
        own = samples[name]
        wall, cpu, of_step = wall_rate(own), cpu_rate(own), ratio(own, samples[TOGETHER])
        table.rows.append([name, rate(wall), rate(cpu), times(of_step)])
        data = {"configuration": name, "steps_per_s": wall, "steps_per_cpu_s": cpu}
        table.data.append(data | {"of_step": of_step})
    table.rows += [[name, why, "", ""] for name, why in missing.items()]
    return table


def _free(samples: dict[str, list[Sample]]) -> Table:
    table = Table(FREE_TITLE, FREE_HEADER)
    for name in (ALONE, AT_ONCE):
        wall, of_one = wall_rate(samples[name]), ratio(samples[name], samples[ALONE])
        table.rows.append([name, rate(wall), times(of_one)])
        table.data.append({"configuration": name, "products_per_s": wall, "of_one": of_one})
    return table


def _make(stack: ExitStack, folder: Path, size: int) -> fmugym.FMUVectorEnv:
    require_native_pool()
    path = build_busy(folder)
    env = fmugym.FMUVectorEnv(lambda: BusyEnv(path, MEAN), size, threads=1)
    stack.callback(env.close)
    env.reset(seed=0)
    return env


def _learn(num_envs: int) -> None:
    """Work as long on a result as the FMUs have worked on it, in time of the processor.

    Products of matrices leave the interpreter to other threads, as those of a neural network do. A
    fixed number of them would not do: processors change their speed, and an FMU of fixed time does
    not follow.
    """
    product = np.empty(FACTORS[0].shape)
    end = time.thread_time() + 1e-6 * MEAN * num_envs
    while time.thread_time() < end:
        np.dot(*FACTORS, out=product)


def _products(stack: ExitStack, threads: int) -> Run:
    """A fixed number of products for each thread, all threads at once."""
    pool = ThreadPoolExecutor(threads)
    stack.callback(pool.shutdown)

    def multiply(_: int) -> None:
        product = np.empty(FACTORS[0].shape)
        for _ in range(PRODUCTS):
            np.dot(*FACTORS, out=product)

    return repeated(lambda: list(pool.map(multiply, range(threads))), threads * PRODUCTS)


def _together(stack: ExitStack, folder: Path) -> Run:
    env, actions = _make(stack, folder, SIZE), np.zeros(SIZE, np.int64)

    def turn() -> None:
        env.step(actions)
        _learn(SIZE)

    return repeated(turn, SIZE)


def _halves(stack: ExitStack, folder: Path) -> Run:
    halves = [_make(stack, folder, SIZE // 2) for _ in range(2)]
    actions = np.zeros(SIZE // 2, np.int64)
    for half in halves:
        half.step_async(actions)

    def turn() -> None:
        for half in halves:
            half.step_wait()
            _learn(SIZE // 2)
            half.step_async(actions)

    return repeated(turn, SIZE)
