"""Measure the cost of worker processes, and the time of their starts and faults."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from busy import BusyEnv
from c_fmus import build_busy
from measure import Effort, MissingError
from tables import Table, duration, share

import fmugym
from fmugym.environment.vector.env_maker import make_with_pool
from fmugym.envs import CartPoleEnv

__all__ = ["tables"]

CALLS = 2000
"""Calls in a row, before the turn of the other configuration."""
SIZE = 64
MEAN = 100.0
"""Time of a step of the heavy FMU in us."""
TIMEOUT = 0.2
"""Time-out for the hang in seconds."""


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    with ExitStack() as stack:
        return [_cost(stack, effort), _faults(stack, effort), _starts(effort)]


def _cost(stack: ExitStack, effort: Effort) -> Table:
    header = ["a step of the pool", "in-process", "in one worker", "added", ""]
    table = Table("Worker processes: median time of a call", header)
    _add_cost(table, "1 cart-pole", _pools(stack, CartPoleEnv, 1), effort)
    try:
        path = build_busy(Path(stack.enter_context(tempfile.TemporaryDirectory())))
    except MissingError as reason:
        table.rows.append([f"{SIZE} heavy FMUs", str(reason), "", "", ""])
        return table
    pools = _pools(stack, lambda: BusyEnv(path, MEAN, 0.0), SIZE)
    name = f"{SIZE} FMUs of {duration(1e-6 * MEAN)} each"
    _add_cost(table, name, pools, effort._replace(rounds=min(effort.rounds, 5)), CALLS // 100)
    return table


def _pools(stack: ExitStack, make_env: Callable[[], Any], count: int) -> list[Any]:
    """Make a pool on a single thread here, and one in a single worker."""
    pools = []
    for options in ({"isolation": "none"}, {"isolation": "process", "workers": 1}):
        env = make_with_pool(make_env, count, threads=1, **options)
        stack.callback(env.close)
        draws = env.episode_start
        pools.append(env.pool)
        env.pool.reset(draws.model_variables, np.repeat(draws.constants[:, None], count, axis=1))
    return pools


def _add_cost(
    table: Table, name: str, pools: list[Any], effort: Effort, calls: int = CALLS
) -> None:
    calls = 10 if effort.quick else calls
    rounds = [[median_time(pool.step_own, calls) for pool in pools] for _ in range(effort.rounds)]
    here, there = (statistics.median(times) for times in zip(*rounds, strict=True))
    added = statistics.median(b - a for a, b in rounds)
    cells = [duration(here), duration(there), duration(added), share(added / here)]
    table.rows.append([name, *cells])
    table.data.append({"configuration": name, "in_process_s": here, "in_worker_s": there})


def median_time(call: Callable[[], object], count: int) -> float:
    """Return the median time of some calls in seconds."""
    times = []
    for _ in range(count):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def _faults(stack: ExitStack, effort: Effort) -> Table:
    table = Table("Worker processes: faults of one cart-pole", ["what", "median", "longest"])
    count = 3 if effort.quick else 30
    env = make_with_pool(_quiet_env, isolation="process")
    stack.callback(env.close)
    cases: dict[str, Callable[[], float]] = {
        "a worker is killed: until the step is truncated": lambda: _death(env),
        "then until the reset has given an observation": lambda: _restart(env),
    }
    for name, measure in cases.items():
        _add_times(table, name, [_after_death(env, measure) for _ in range(count)])
    hangs = [_hang(stack) for _ in range(1 if effort.quick else 10)]
    _add_times(table, f"a step hangs: after its time-out of {duration(TIMEOUT)}", hangs)
    return table


def _quiet_env() -> CartPoleEnv:
    return CartPoleEnv(log_level=logging.CRITICAL)


def _after_death(env: Any, measure: Callable[[], float]) -> float:
    env.reset()
    return measure()


def _death(env: Any) -> float:
    begin = time.perf_counter()
    os.kill(env.pool.processes()[0], signal.SIGKILL)
    while not env.step(0)[3]:
        continue
    return time.perf_counter() - begin


def _restart(env: Any) -> float:
    _death(env)
    begin = time.perf_counter()
    env.reset()
    return time.perf_counter() - begin


def _hang(stack: ExitStack) -> float:
    """Stop a worker, so that it does not answer; return the time after its time-out."""
    env = make_with_pool(_quiet_env, isolation="process", call_timeout=TIMEOUT)
    stack.callback(env.close)
    env.reset()
    os.kill(env.pool.processes()[0], signal.SIGSTOP)
    begin = time.perf_counter()
    while not env.step(0)[3]:
        continue
    return time.perf_counter() - begin - TIMEOUT


class _Met(fmugym.FMI2CSEnv):
    """A cart-pole whose FMU is not known to be one of the package."""

    def __init__(self, path: Path) -> None:
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "theta"],
            "bounds": {"f": (-10.0, 10.0)},
            "time_step": 0.05,
        }
        super().__init__(path, config)

    def _is_done(self) -> Any:
        return abs(self.state[0]) > MEAN


def _starts(effort: Effort) -> Table:
    table = Table("Worker processes: starts", ["what", "median", "longest"])
    count = 1 if effort.quick else 11
    name = f"{SIZE} cart-poles in {SIZE} workers: until the first step is answered"
    _add_times(table, name, [_first_step() for _ in range(count)])
    meetings = [_meetings() for _ in range(count)]
    names = "an FMU that is new here: constructor, with the trial", "the same, when it is known"
    for what, times in zip(names, zip(*meetings, strict=True), strict=True):
        _add_times(table, what, list(times))
    return table


def _first_step() -> float:
    begin = time.perf_counter()
    envs = fmugym.FMUVectorEnv(_quiet_env, SIZE, isolation="process", workers=SIZE)
    envs.reset(seed=0)
    envs.step(np.zeros(SIZE, np.int64))
    end = time.perf_counter()
    envs.close()
    return end - begin


def _meetings() -> tuple[float, float]:
    """The times of the first and of the second environment over an FMU."""
    times = []
    with tempfile.TemporaryDirectory() as folder, _variable("FMUGYM_CACHE_DIR", folder):
        path = Path(shutil.copy(fmugym.bundled_fmu("CartPole"), folder))
        for _ in range(2):
            begin = time.perf_counter()
            env = _Met(path)
            times.append(time.perf_counter() - begin)
            env.close()
    return times[0], times[1]


@contextmanager
def _variable(name: str, value: str) -> Iterator[None]:
    """Set an environment variable."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]
        if before is not None:
            os.environ[name] = before


def _add_times(table: Table, name: str, times: list[float]) -> None:
    table.rows.append([name, duration(statistics.median(times)), duration(max(times))])
    table.data.append({"what": name, "median_s": statistics.median(times), "max_s": max(times)})
