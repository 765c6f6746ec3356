"""Measure typical tasks: compiled, on arrays, written by hand in numpy, and in Gymnasium's vectors.

All run on one thread. The cells show the time of a call of ``step``, and how many times faster the
task is than written by hand, without the time of the FMUs themselves on both sides.
"""

from __future__ import annotations

import statistics
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import by_hand
import c_limit
import gymnasium as gym
import numpy as np
import user_tasks
from c_fmus import build_building
from cart_poles import require_native_pool
from measure import Effort, MissingError, Run, Sample, Stopwatch, by_turns, make_runs
from tables import Table, duration, times

import fmugym
from fmugym.task.interface import resolve

__all__ = ["TASKS", "Task", "fmugym_run", "tables"]

SIZES = (1, 8, 64, 1024, 4096)
TITLE = (
    "Tasks, one thread: time of a step of all environments; in brackets, how many times faster\n"
    "than by hand in numpy, without the time of the FMUs themselves"
)
_LEAST_SHARE = 0.1
"""The smallest part of a step that is compared, if the rest is the time of the FMUs."""

FMU, BY_HAND = "FMUs alone, in C", "by hand in numpy"
MOST = {"SyncVectorEnv": 64, "AsyncVectorEnv": 8}
"""The largest sizes; larger ones would take longer and show nothing new."""


class Task(NamedTuple):
    """A task.

    Attributes:
        name: Its name in the table.
        make: Makes one environment.
        by_hand: The same task in numpy.
        limit: Steps after which an episode is truncated.
    """

    name: str
    make: Callable[[], fmugym.FMUEnv]
    by_hand: type[by_hand.ByHand]
    limit: int


@cache
def _building_fmu() -> Path:
    return build_building(c_limit.build_folder())


def _building() -> fmugym.FMUEnv:
    return user_tasks.Building(_building_fmu())


def _registered(name: str) -> Any:
    return gym.make(f"fmugym/{name}", disable_env_checker=True).unwrapped


TASKS = (
    Task("CartPole-v0", partial(_registered, "CartPole-v0"), by_hand.CartPoleByHand, 500),
    Task("Pendulum-v0", partial(_registered, "Pendulum-v0"), by_hand.PendulumByHand, 200),
    Task(
        "CloudPendulum-v0",
        partial(_registered, "CloudPendulum-v0"),
        by_hand.CloudPendulumByHand,
        500,
    ),
    Task("SwingUp of the README", user_tasks.SwingUp, by_hand.SwingUpByHand, 500),
    Task("tracking", user_tasks.Tracking, by_hand.TrackingByHand, 250),
    Task("tracking, one hook in numpy", user_tasks.Uncompiled, by_hand.UncompiledByHand, 250),
    Task("goal", user_tasks.Goal, by_hand.GoalByHand, 200),
    Task("building", _building, by_hand.BuildingByHand, 96),
)


def tables(effort: Effort) -> list[Table]:
    """Measure all tasks at all sizes; one row for each way to run a task."""
    require_native_pool()
    sizes = SIZES[:2] if effort.quick else SIZES
    table = Table(TITLE, ["task", *map(str, sizes)])
    for task in TASKS:
        _add(table, task, sizes, effort)
    return [table]


def _add(table: Table, task: Task, sizes: tuple[int, ...], effort: Effort) -> None:
    columns = []
    for size in sizes:
        with ExitStack() as stack:
            makers = dict(_makers(stack, task, size))
            runs, missing = make_runs(makers)
            columns.append((by_turns(runs, effort), missing, size))
    for name in makers:
        cells = [_cell(name, samples, missing) for samples, missing, _ in columns]
        table.rows.append([f"{task.name}: {name}", *cells])
    table.data += [
        {"task": task.name, "way": name, "num_envs": size, "call_s": _median(samples[name])}
        for samples, _, size in columns
        for name in samples
    ]


def _makers(stack: ExitStack, task: Task, size: int) -> Iterator[tuple[str, Callable[[], Run]]]:
    yield FMU, lambda: _fmu_run(stack, task, size)
    yield "fmugym", lambda: fmugym_run(stack, task, size, "auto")
    yield 'hooks="array"', lambda: fmugym_run(stack, task, size, "array")
    yield BY_HAND, lambda: _by_hand(stack, task, size)
    for name in MOST:
        yield name, lambda name=name: _gymnasium(stack, task, size, name)


def fmugym_run(stack: ExitStack, task: Task, size: int, hooks: str) -> Run:
    """Make a run of a vector environment of this package on one thread."""
    envs = fmugym.FMUVectorEnv(
        task.make, size, max_episode_steps=task.limit, hooks=hooks, threads=1
    )
    stack.callback(envs.close)
    return _run(envs, envs.action_space)


def _by_hand(stack: ExitStack, task: Task, size: int) -> Run:
    env = task.make()
    stack.callback(env.close)
    envs = task.by_hand(env, size, task.limit)
    stack.callback(envs.close)
    return _run(envs, gym.vector.utils.batch_space(env.action_space, size))


def _gymnasium(stack: ExitStack, task: Task, size: int, name: str) -> Run:
    if size > MOST[name]:
        raise MissingError("-")
    options = {"context": "fork"} if name == "AsyncVectorEnv" else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        make = partial(gym.wrappers.TimeLimit, max_episode_steps=task.limit)
        envs = getattr(gym.vector, name)([lambda: make(task.make())] * size, **options)
    stack.callback(envs.close)
    return _run(envs, envs.action_space)


def _run(envs: Any, space: gym.Space[Any]) -> Run:
    """Count calls of ``step`` with a few random actions that repeat."""
    space.seed(0)
    actions = [space.sample() for _ in range(16)]
    envs.reset()

    def run(seconds: float) -> Sample:
        watch, done = Stopwatch(), 0
        while watch.wall < seconds:
            watch.start()
            for action in actions:
                envs.step(action)
            watch.stop()
            done += len(actions)
        return watch.sample(done)

    return run


def _fmu_run(stack: ExitStack, task: Task, size: int) -> Run:
    """Count what would be calls of ``step`` if they took the time of the FMUs alone."""
    env = task.make()
    stack.callback(env.close)
    loop = _loop_of(env)
    c_limit.build()

    def run(seconds: float) -> Sample:
        rates = c_limit.measure(loop, size, 1, seconds)
        return Sample(rates.wall / size * seconds, seconds, seconds)

    return run


def _loop_of(env: fmugym.FMUEnv) -> c_limit.Loop:
    """What a bare C program has to do to step this environment's FMU."""
    config, parameters = env.config, {}
    for name, value in resolve(config, env.fmu.description).parameters.items():
        middle = (value.low + value.high) / 2 if isinstance(value, fmugym.Uniform) else value
        is_real = env.fmu.variable(name).kind == "real"
        parameters[name] = float(middle) if is_real else int(middle)
    return c_limit.Loop(
        env.fmu,
        config.time_step,
        dict.fromkeys(config.model_input_names, 0.01),
        dict.fromkeys(config.model_output_names, np.inf),
        {},
        parameters,
    )


def _median(samples: list[Sample]) -> float:
    return statistics.median(sample.wall / sample.count for sample in samples)


def _cell(name: str, samples: dict[str, list[Sample]], missing: dict[str, str]) -> str:
    if name not in samples:
        return missing.get(name, "-")
    own = _median(samples[name])
    if name == FMU:
        return duration(own)
    fmus, hand = _median(samples[FMU]), _median(samples[BY_HAND])
    if own - fmus < _LEAST_SHARE * own:  # the difference would be noise
        return duration(own)
    return f"{duration(own)} ({times((hand - fmus) / (own - fmus))})"
