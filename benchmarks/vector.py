"""Measure the steps per second of vector environments, of this package and of others."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import cart_poles
import gymnasium as gym
from by_hand import TrackingByHand
from cart_poles import GYMNASIUM, STEPS
from gate_rows import CartPoleOnArrays
from gymnasium.vector.utils import batch_space
from measure import (
    Effort,
    Run,
    Sample,
    by_turns,
    cpu_rate,
    make_runs,
    ratio,
    thread_counts,
    wall_rate,
)
from tables import Table, rate, share, times
from user_tasks import Tracking

import fmugym

__all__ = ["tables"]

SIZES = (1, 8, 64, 1024, 4096)
MOST = {"Gymnasium SyncVectorEnv": 64, "Gymnasium AsyncVectorEnv": 8}
"""The largest sizes; larger ones would take longer and show nothing new."""

BASE, LIMIT = "Gymnasium make_vec (numpy)", "C limit, 1 thread"
TRACKING, TRACKING_BASE = "tracking task, fmugym, 1 thread", "tracking task, by hand in numpy"
"""A task of a user; its ratio is to the same task written by hand."""

TITLES = (
    "Vector environments: steps/s, and how many times that of Gymnasium's numpy vector",
    "Vector environments: steps/CPU-s, and wall-clock share of the C limit with as many threads",
)


def tables(effort: Effort) -> list[Table]:
    """Measure all sizes, one per column."""
    sizes = SIZES[:2] if effort.quick else SIZES
    header = ["environments", *map(str, sizes)]
    walls, cpus = (Table(title, header) for title in TITLES)
    columns = [_column(size, effort) for size in sizes]
    for name in columns[0]:
        cells = [column[name] for column in columns]
        walls.rows.append([name, *(cell[0] for cell in cells)])
        cpus.rows.append([name, *(cell[1] for cell in cells)])
        walls.data += [cell[2] for cell in cells]
    return [walls, cpus]


def _column(size: int, effort: Effort) -> dict[str, tuple[str, str, dict[str, Any]]]:
    """Return the two cells of each configuration, and their figures."""
    with ExitStack() as stack:
        makers = dict(_makers(stack, size))
        runs, missing = make_runs({n: m for n, m in makers.items() if size <= MOST.get(n, size)})
        samples = by_turns(runs, effort)
    column = {}
    for name in makers:
        head = {"configuration": name, "num_envs": size}
        text = missing.get(name, "-")
        column[name] = _cells(name, samples, head) if name in runs else (text, text, head)
    return column


def _makers(stack: ExitStack, size: int) -> Iterator[tuple[str, Callable[[], Run]]]:
    threads = thread_counts()
    for count, text in threads.items():
        yield f"fmugym, {text}", lambda n=count: _fmugym(stack, size, threads=n)
    *_, (most, text) = threads.items()
    for mode in ("SAME_STEP", "DISABLED"):
        options = {"autoreset_mode": mode.lower(), "threads": most}
        yield f"fmugym, {mode}, {text}", lambda o=options: _fmugym(stack, size, **o)
    yield f"fmugym, hooks on arrays, {text}", lambda: _on_arrays(stack, size, most)
    yield BASE, lambda: _gymnasium(stack, size, "vector_entry_point")
    yield "Gymnasium SyncVectorEnv", lambda: _gymnasium(stack, size, "sync")
    yield "Gymnasium AsyncVectorEnv", lambda: _gymnasium(stack, size, "async", context="spawn")
    yield TRACKING, lambda: _tracking(stack, size, by_hand=False)
    yield TRACKING_BASE, lambda: _tracking(stack, size, by_hand=True)
    for count, text in threads.items():
        yield f"EnvPool, {text}", lambda n=count: cart_poles.envpool_run(stack, size, n)
    for count, text in threads.items():
        yield f"C limit, {text}", lambda n=count: cart_poles.c_limit_run(size, n)


def _tracking(stack: ExitStack, size: int, by_hand: bool) -> Run:
    cart_poles.require_native_pool()
    prototype = Tracking()
    stack.callback(prototype.close)
    space = batch_space(prototype.action_space, size)
    space.seed(0)
    env: Any = (
        TrackingByHand(prototype, size, prototype.config.max_episode_steps)
        if by_hand
        else fmugym.FMUVectorEnv(Tracking, size, threads=1)
    )
    stack.callback(env.close)
    return cart_poles.vector_run(env, [space.sample() for _ in range(STEPS)])


def _fmugym(stack: ExitStack, size: int, **options: Any) -> Run:
    env = cart_poles.fmugym_vector(size, **options)
    stack.callback(env.close)
    return cart_poles.vector_run(env)


def _on_arrays(stack: ExitStack, size: int, threads: int) -> Run:
    cart_poles.require_native_pool()
    env = fmugym.FMUVectorEnv(CartPoleOnArrays, size, threads=threads)
    stack.callback(env.close)
    return cart_poles.vector_run(env)


def _gymnasium(stack: ExitStack, size: int, mode: str, **options: Any) -> Run:
    env = gym.make_vec(GYMNASIUM, size, vectorization_mode=mode, vector_kwargs=options)
    stack.callback(env.close)
    return cart_poles.vector_run(env)


def _cells(
    name: str, samples: dict[str, list[Sample]], data: dict[str, Any]
) -> tuple[str, str, dict[str, Any]]:
    own = samples[name]
    data |= {"steps_per_s": wall_rate(own), "steps_per_cpu_s": cpu_rate(own)}
    is_tracking = name in {TRACKING, TRACKING_BASE}
    data["of_base"] = ratio(own, samples[TRACKING_BASE if is_tracking else BASE])
    limit = None if is_tracking else samples.get(_limit(name, samples))
    data["of_limit"] = ratio(own, limit) if limit else None
    wall = f"{rate(data['steps_per_s'])} {times(data['of_base'])}"
    part = share(data["of_limit"]) if limit else ""
    return wall, f"{rate(data['steps_per_cpu_s'])} {part}".rstrip(), data


def _limit(name: str, samples: dict[str, list[Sample]]) -> str:
    """Return the name of the C program with as many threads, if there are enough environments."""
    threads = name.rpartition(", ")[2] if name.endswith("threads") else "1 thread"
    own = f"C limit, {threads}"
    return own if own in samples else LIMIT
