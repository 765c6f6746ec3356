"""Speed of a task: steps per second of one environment and of many, and the FMU's share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, Final

import numpy as np
from gymnasium.vector import AutoresetMode

from fmugym.checks import number_of
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, FMUGymError
from fmugym.vector import FMUVectorEnv

__all__ = ["Speed", "SpeedReport", "bench", "speed_table"]

_ROUNDS: Final = 5
"""Number of measurements, the fastest of which counts: other load only makes them slower."""

_CAUTION: Final = (
    "Measured on this machine as it is now. Close other programs, measure several times, and "
    "compare\nonly what was measured together: a busy machine or a slower clock halves these "
    "figures."
)


@dataclass(frozen=True)
class Speed:
    """The speed of environments that step together.

    Attributes:
        envs: How many; 0 stands for a single environment without vectors.
        hooks: Calls of the hooks.
        steps_per_second: Steps per second of all environments together, resets included.
        microseconds: Real time of one call of ``step``.
        fmu_share: The part of it that the FMUs take by themselves; None if it cannot be measured.
    """

    envs: int
    hooks: str
    steps_per_second: float
    microseconds: float
    fmu_share: float | None


@dataclass(frozen=True)
class SpeedReport:
    """The result of a measurement.

    Attributes:
        speeds: Speeds of a single environment, and of vector environments.
        time_step: The simulated seconds in a step.
        processors: How many this process may use.
        load: The mean number of running programs in the last minute; None if it is not known.
    """

    speeds: tuple[Speed, ...]
    time_step: float
    processors: int
    load: float | None


def bench(
    make_env: Callable[[], FMUEnv], sizes: Iterable[int], seconds: float
) -> Iterator[SpeedReport]:
    """Measure the speed of a task with random actions.

    Args:
        make_env: A function that makes the environment.
        sizes: The sizes of vector environments.
        seconds: Real time of each measurement.

    Yields:
        After each measurement a report with all speeds until then.

    Raises:
        ConfigError: If ``seconds`` is not positive.
        FMUGymError: If an environment cannot be made, or fails.
    """
    if number_of("--seconds", seconds) <= 0:
        raise ConfigError(f"--seconds must be positive, got {seconds:g}")
    load: float | None = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    with closing(make_env()) as env:
        time_step = env.pool_spec.time_step
        report = SpeedReport((_of_single(env, seconds),), time_step, _processors(), load)
    yield report
    for size in sizes:
        report = replace(report, speeds=(*report.speeds, _of_vector(make_env, size, seconds)))
        yield report


def _processors() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return os.cpu_count() or 1 if affinity is None else len(affinity(0))


def _of_single(env: FMUEnv, seconds: float) -> Speed:
    actions = [env.action_space.sample() for _ in range(64)]

    def step(number: int) -> None:
        result = env.step(actions[number % 64])
        if result[2] or result[3]:
            env.reset()

    env.reset(seed=0)
    _fastest(step, seconds / 4)
    took = _fastest(step, seconds)
    hooks = "expressions" if env.is_compiled else "Python"
    env.reset(seed=0)
    return Speed(0, hooks, 1.0 / took, took * 1e6, _share(env, seconds, took))


def _of_vector(make_env: Callable[[], FMUEnv], size: int, seconds: float) -> Speed:
    with closing(FMUVectorEnv(make_env, size, autoreset_mode=AutoresetMode.SAME_STEP)) as envs:
        envs.reset(seed=0)
        actions = [envs.action_space.sample() for _ in range(16)]
        took = _fastest(lambda number: envs.step(actions[number % 16]), seconds)
        envs.reset(seed=0)
        share = _share(envs.prototype, seconds, took)
        return Speed(size, envs.task.way, size / took, took * 1e6, share)


def _fastest(step: Callable[[int], Any], seconds: float) -> float:
    """The seconds of a call, in the fastest of some rounds."""
    count, number, best = _count(step, seconds / _ROUNDS), 0, float("inf")
    for _ in range(_ROUNDS):
        begin = perf_counter()
        for _ in range(count):
            step(number)
            number += 1
        best = min(best, (perf_counter() - begin) / count)
    return best


def _count(step: Callable[[int], Any], seconds: float) -> int:
    """Estimated number of calls in a time."""
    count = 1
    while True:
        begin = perf_counter()
        for number in range(count):
            step(number)
        took = perf_counter() - begin
        if took > seconds / 4 or count >= 1_000_000:
            return max(1, round(count * seconds / max(took, 1e-9)))
        count *= 2


def _share(env: FMUEnv, seconds: float, took: float) -> float | None:
    """The part of a step that the pool takes for the FMUs alone, without hooks and resets.

    The FMUs go on from the beginning of an episode with their first inputs, for as many steps as an
    episode may have, so that they stay near states that occur.
    """
    pool = env.pool
    variables = tuple(env.episode_start.model_variables)
    rng = np.random.default_rng(0)
    limit = min(env.step_limit, 1000)
    best = float("inf")
    end = perf_counter() + seconds / 2
    try:
        while perf_counter() < end:
            pool.reset(variables, env.episode_start.draw_starts(rng, pool.num_instances))
            begin = perf_counter()
            for _ in range(limit):
                pool.step(None)
            best = min(best, (perf_counter() - begin) / limit)
    except FMUGymError:
        return None
    return min(1.0, best / took)


def speed_table(report: SpeedReport) -> str:
    """Format speeds for a terminal."""
    header = ("environments", "hooks", "steps/s", "us per call", "FMU's share", "x real time")
    rows = [header, *(_row(speed, report.time_step) for speed in report.speeds)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    lines = [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    ]
    load = "" if report.load is None else f", {report.load:.2g} programs were running before"
    return "\n".join([*lines, "", f"{report.processors} processors{load}", _CAUTION])


def _row(speed: Speed, time_step: float) -> tuple[str, ...]:
    return (
        str(speed.envs) if speed.envs else "single",
        speed.hooks,
        f"{speed.steps_per_second:,.0f}",
        f"{speed.microseconds:.4g}",
        "" if speed.fmu_share is None else f"{100 * speed.fmu_share:.0f} %",
        f"{speed.steps_per_second * time_step:.3g}",
    )
