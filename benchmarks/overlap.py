"""Measure a learner that takes as long as its FMUs, in turn with them and at the same time."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from busy import BusyEnv
from c_fmus import build_busy
from cart_poles import require_native_pool
from measure import Effort, Run, Sample, Stopwatch, by_turns, cpu_rate, make_runs, ratio, wall_rate
from tables import Table, rate, times

import fmugym

__all__ = ["tables"]

TITLE = "A learner that takes as long as its 32 FMUs of 100 us a step, each on one thread: steps/s"
HEADER = ["configuration", "steps/s", "steps/CPU-s", "of step"]
SIZE, MEAN = 32, 100.0
FACTORS = np.random.default_rng(0).normal(size=(2, 56, 56)) / 10
"""So small that BLAS multiplies them on one thread: the other processor is for the FMUs."""
TOGETHER, HALVES = "step, then learn", "step_async of two halves in turn"


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    table = Table(TITLE, HEADER)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, ExitStack() as stack:
        makers: dict[str, Callable[[], Run]] = {
            TOGETHER: lambda: _together(stack, Path(folder)),
            HALVES: lambda: _halves(stack, Path(folder)),
        }
        runs, missing = make_runs(makers)
        samples = by_turns(runs, effort)
    for name, own in samples.items():
        wall, cpu, of_step = wall_rate(own), cpu_rate(own), ratio(own, samples[TOGETHER])
        table.rows.append([name, rate(wall), rate(cpu), times(of_step)])
        data = {"configuration": name, "steps_per_s": wall, "steps_per_cpu_s": cpu}
        table.data.append(data | {"of_step": of_step})
    table.rows += [[name, why, "", ""] for name, why in missing.items()]
    return [table]


def _make(stack: ExitStack, folder: Path, size: int) -> fmugym.FMUVectorEnv:
    require_native_pool()
    path = build_busy(folder)
    env = fmugym.FMUVectorEnv(lambda: BusyEnv(path, MEAN), size, threads=1)
    stack.callback(env.close)
    env.reset(seed=0)
    return env


def _learner() -> Callable[[int], None]:
    """Make a learner that works as long on a result as the FMUs have worked on it.

    Products of matrices leave the interpreter to other threads, as those of a neural network do.
    """
    product = np.empty(FACTORS[0].shape)
    begin, count = time.perf_counter(), 2000
    for _ in range(count):
        np.dot(*FACTORS, out=product)
    per_env = max(1, round(MEAN * 1e-6 * count / (time.perf_counter() - begin)))

    def learn(num_envs: int) -> None:
        for _ in range(per_env * num_envs):
            np.dot(*FACTORS, out=product)

    return learn


def _together(stack: ExitStack, folder: Path) -> Run:
    env, learn, actions = _make(stack, folder, SIZE), _learner(), np.zeros(SIZE, np.int64)

    def turn() -> None:
        env.step(actions)
        learn(SIZE)

    return _repeated(turn)


def _halves(stack: ExitStack, folder: Path) -> Run:
    halves = [_make(stack, folder, SIZE // 2) for _ in range(2)]
    learn, actions = _learner(), np.zeros(SIZE // 2, np.int64)
    for half in halves:
        half.step_async(actions)

    def turn() -> None:
        for half in halves:
            half.step_wait()
            learn(SIZE // 2)
            half.step_async(actions)

    return _repeated(turn)


def _repeated(turn: Callable[[], Any]) -> Run:
    """Count the steps of all environments."""

    def run(seconds: float) -> Sample:
        watch, done = Stopwatch(), 0
        while watch.wall < seconds:
            watch.start()
            turn()
            watch.stop()
            done += SIZE
        return watch.sample(done)

    return run
