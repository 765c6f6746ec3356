"""Measure the memory of an environment, in processes of their own."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from cart_poles import fmugym_vector, require_native_pool
from measure import Effort, MissingError
from tables import Table

__all__ = ["tables"]


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    table = Table("Memory of make_vec", ["figure", "value"])
    few, many = (1_000, 5_000) if effort.quick else (1_000, 20_000)
    try:
        require_native_pool()
        each = (in_child(resident_with, many) - in_child(resident_with, few)) / (many - few)
        name = f"memory per environment, from {few:,} to {many:,}"
        table.rows.append([name, f"{each:,.0f} B"])
        table.data.append({"figure": name, "value": each})
    except MissingError as reason:
        table.rows.append(["all", str(reason)])
    return [table]


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
