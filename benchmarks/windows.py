"""Measure a worker in Wine beside a native worker: the same FMU, with its library for Windows."""

from __future__ import annotations

import logging
import statistics
import tempfile
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from isolation import median_time
from measure import Effort
from tables import Table, duration

import fmugym
from fmugym.vector.making import make_with_pool
from fmugym.wine.installation import can_run_windows, obstacle_to_wine

__all__ = ["tables"]

CALLS = 2000
"""Calls in a row, before the turn of the other configuration."""
SIZES = (1, 64, 1024)


class PushedCartPoleEnv(fmugym.FMI2CSEnv):
    """A cart-pole that is pushed, over any copy of the FMU."""

    def __init__(self, path: Path) -> None:
        config = {
            "model_input_names": "f",
            "model_output_names": ["x", "x_dot", "theta", "theta_dot"],
            "time_step": 0.02,
        }
        super().__init__(path, config, logging.ERROR)

    def _is_done(self) -> Any:
        return abs(self.state[0]) > 2.4


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    header = ["a step of the pool", "native worker", "worker in Wine", "added"]
    table = Table("An FMU for Windows: median time of a call, one worker", header)
    reason = obstacle_to_wine() if can_run_windows() else "Wine runs on Linux on x86_64 only"
    if reason:
        table.rows.append(["in Wine", reason, "", ""])
        return [table]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        paths = fmugym.bundled_fmu("CartPole"), _for_windows(folder)
        for size in SIZES[:1] if effort.quick else SIZES:
            _add(table, size, [_pool(stack, path, size) for path in paths], effort)
    return [table]


def _for_windows(folder: Path) -> Path:
    """Copy the cart-pole without its libraries for other systems."""
    target = folder / "CartPole.fmu"
    with (
        zipfile.ZipFile(fmugym.bundled_fmu("CartPole")) as source,
        zipfile.ZipFile(target, "w") as copy,
    ):
        for name in source.namelist():
            if not name.startswith("binaries/") or name.endswith(".dll"):
                copy.writestr(name, source.read(name))
    return target


def _pool(stack: ExitStack, path: Path, size: int) -> Any:
    """Make a pool in a single worker with a single thread."""
    env = make_with_pool(
        lambda: PushedCartPoleEnv(path), size, isolation="process", workers=1, threads=1
    )
    stack.callback(env.close)
    draws = env.episode_start
    env.pool.reset(draws.model_variables, np.repeat(draws.constants[:, None], size, axis=1))
    return env.pool


def _add(table: Table, size: int, pools: list[Any], effort: Effort) -> None:
    calls = 10 if effort.quick else CALLS
    rounds = [[median_time(pool.step_own, calls) for pool in pools] for _ in range(effort.rounds)]
    native, wine = (statistics.median(times) for times in zip(*rounds, strict=True))
    added = statistics.median(b - a for a, b in rounds)
    name = f"{size:,} cart-pole(s)"
    table.rows.append([name, duration(native), duration(wine), duration(added)])
    table.data.append({"configuration": name, "native_s": native, "wine_s": wine})
