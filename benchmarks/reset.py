"""Measure the cost of starting an episode."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import cart_poles
import gymnasium as gym
import numpy as np
from cart_poles import FMUGYM, GYMNASIUM
from measure import Effort, Run, Sample, by_turns, cpu_rate, make_runs, ratio, repeated, wall_rate
from tables import Table, duration, rate, times

import fmugym
from fmugym.pool import PoolSpec
from fmugym.trial.opening import open_pool
from fmugym.trial.pool_options import PoolOptions

__all__ = ["tables"]

HEADER = ["new start values", "one env", "resets/s", "CPU time", "of Gymnasium"]
SIZE = 1024
START_VALUES = ("x_0", "x_dot_0", "phi_0", "phi_dot_0")
SINGLE, VECTOR = "Gymnasium make, one env", f"Gymnasium make_vec (numpy), {SIZE:,} envs"


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    with ExitStack() as stack:
        runs, missing = make_runs(_makers(stack))
        samples = by_turns(runs, effort)
    table = Table("Resets, per environment", HEADER)
    for name, own in samples.items():
        _add(table, name, own, samples[SINGLE if "one env" in name else VECTOR])
    table.rows += [[name, why, "", "", ""] for name, why in missing.items()]
    return [table]


def _makers(stack: ExitStack) -> dict[str, Callable[[], Run]]:
    return {
        f"fmugym's native pool, mask of all {SIZE:,}": lambda: _pool(stack),
        f"fmugym make_vec, reset_mask of all {SIZE:,}": lambda: _vector(stack, True),
        "fmugym make_vec, reset_mask of every other": lambda: _vector(stack, False),
        VECTOR: lambda: _gymnasium_vector(stack),
        "fmugym make, one env": lambda: _single(stack, FMUGYM),
        SINGLE: lambda: _single(stack, GYMNASIUM),
    }


def _add(table: Table, name: str, own: list[Sample], base: list[Sample]) -> None:
    wall, cpu, gymnasium = wall_rate(own), cpu_rate(own), ratio(own, base)
    cells = [duration(1 / wall), rate(wall), duration(1 / cpu), times(gymnasium)]
    table.rows.append([name, *cells])
    data = {"configuration": name, "resets_per_s": wall, "resets_per_cpu_s": cpu}
    table.data.append(data | {"of_gymnasium": gymnasium})


def _pool(stack: ExitStack) -> Run:
    """Reset with one thread; the instances do a step between two resets."""
    cart_poles.require_native_pool()
    fmu = fmugym.FMU(fmugym.bundled_fmu("CartPole"))
    outputs = tuple(map(fmu.variable, ("x", "x_dot", "phi", "phi_dot")))
    spec = PoolSpec((fmu.variable("f"),), outputs, 0.02, num_observed=4)
    pool = open_pool(fmu, spec, SIZE, logging.getLogger(__name__), PoolOptions("native", threads=1))
    stack.callback(pool.close)
    variables, mask = tuple(map(fmu.variable, START_VALUES)), np.ones(SIZE, np.bool_)
    values = itertools.cycle(np.random.default_rng(0).uniform(-0.05, 0.05, (16, 4, SIZE)))
    pool.reset(variables, next(values))
    return repeated(lambda: pool.reset(variables, next(values), mask), SIZE, pool.step)


def _vector(stack: ExitStack, every: bool) -> Run:
    env = cart_poles.fmugym_vector(SIZE, threads=1, autoreset_mode="Disabled")
    stack.callback(env.close)
    mask = np.arange(SIZE) % 2 == 0
    options = {"reset_mask": mask | every}
    env.reset(seed=0)
    return repeated(lambda: env.reset(options=options), int(options["reset_mask"].sum()))


def _gymnasium_vector(stack: ExitStack) -> Run:
    env: Any = gym.make_vec(GYMNASIUM, SIZE, vectorization_mode="vector_entry_point")
    stack.callback(env.close)
    return repeated(env.reset, SIZE)


def _single(stack: ExitStack, env_id: str) -> Run:
    env = gym.make(env_id)
    stack.callback(env.close)
    env.reset(seed=0)

    def block() -> None:
        for _ in range(cart_poles.STEPS):
            env.reset()

    return repeated(block, cart_poles.STEPS)
