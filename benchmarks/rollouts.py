"""Measure rollouts, and saving and restoring, on a cart-pole whose episodes do not end."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import c_limit
import numpy as np
from calling import ARRAYS, in_way
from gymnasium import spaces
from measure import Effort, Run, Sample, by_turns, cpu_rate, make_runs, ratio, repeated, wall_rate
from tables import Table, duration, rate, times

import fmugym
from fmugym.envs import CartPoleEnv

__all__ = ["tables"]

CANDIDATES, HORIZON, THREADS = 1024, 50, 2
LIMIT = "C limit: the FMU's functions only"
LIMITS = ("x_threshold", "theta_threshold_radians")
HEADERS = (
    ["rollouts", "steps/s", "CPU time a step", "of the C limit"],
    ["snapshots", "one env", "CPU time", ""],
)


class EndlessCartPole(CartPoleEnv):
    """The cart-pole without an end, so that every candidate does all steps."""

    def __init__(self) -> None:
        super().__init__(model_parameters=dict.fromkeys(LIMITS, 1e30))

    def _get_observation_space(self) -> spaces.Space[Any]:
        return spaces.Box(-math.inf, math.inf, (4,), np.float32)


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    with ExitStack() as stack:
        runs, missing = make_runs(_rollouts(stack))
        rolled = by_turns(runs, effort)
        saved = by_turns(_snapshots(stack), effort)
    title = f"Rollouts of {CANDIDATES:,} candidates, {HORIZON} steps, {THREADS} threads"
    first, second = Table(title, HEADERS[0]), Table("Snapshots, per environment", HEADERS[1])
    for name, own in rolled.items():
        share = times(ratio(own, rolled[LIMIT])) if LIMIT in rolled else ""
        _add(first, name, own, rate(wall_rate(own)), share)
    first.rows += [[name, why, "", ""] for name, why in missing.items()]
    for name, own in saved.items():
        _add(second, name, own, duration(1 / wall_rate(own)), "")
    return [first, second]


def _add(table: Table, name: str, own: list[Sample], figure: str, share: str) -> None:
    wall, cpu = wall_rate(own), cpu_rate(own)
    table.rows.append([name, figure, duration(1 / cpu), share])
    table.data.append({"configuration": name, "per_s": wall, "per_cpu_s": cpu})


def _rollouts(stack: ExitStack) -> dict[str, Callable[[], Run]]:
    return {
        "expressions, from one snapshot": lambda: _rollout(stack, None),
        "hooks on arrays, from one snapshot": lambda: _rollout(stack, ARRAYS),
        LIMIT: _limit,
    }


def _make(stack: ExitStack, way: str | None) -> fmugym.FMUVectorEnv:
    envs = fmugym.FMUVectorEnv(in_way(way, EndlessCartPole), CANDIDATES, threads=THREADS)
    stack.callback(envs.close)
    return envs


def _rollout(stack: ExitStack, way: str | None) -> Run:
    envs, actions = (
        _make(stack, way),
        np.random.default_rng(0).integers(0, 2, (CANDIDATES, HORIZON)),
    )
    with EndlessCartPole() as env:
        env.reset(seed=0)
        snapshot = env.save_state()
    return repeated(lambda: envs.rollout(snapshot, actions), CANDIDATES * HORIZON)


def _limit() -> Run:
    loop = c_limit.cart_pole()
    endless = loop._replace(outputs=dict.fromkeys(loop.outputs, math.inf))
    c_limit.build()

    def run(seconds: float) -> Sample:
        rates = c_limit.measure(endless, CANDIDATES, THREADS, seconds)
        count = rates.wall * seconds
        return Sample(count, seconds, count / rates.cpu)

    return run


def _snapshots(stack: ExitStack) -> dict[str, Run]:
    envs = _make(stack, None)
    envs.reset(seed=0)
    snapshot = envs.save_state()
    return {
        f"save_state of {CANDIDATES:,}": repeated(envs.save_state, CANDIDATES),
        f"restore_state of {CANDIDATES:,}": repeated(
            lambda: envs.restore_state(snapshot), CANDIDATES
        ),
    }
