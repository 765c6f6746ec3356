"""Measure typical tasks: as they are, on arrays, by hand in numpy, and in Gymnasium's vectors.

All run on one thread. A way plays the same steps again and again, in turns with the others. Their
time is the sum of the least times that each 16 calls of ``step`` have taken, because other work on
the machine only adds to it. The FMUs' own time is that of a C program which repeats the inputs and
the starts of these very steps: what a step of an FMU costs depends on the inputs and on where it
is. So the cells can show how many times faster a task is than by hand without the FMUs' time.
"""

from __future__ import annotations

import time
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
from calling import ARRAYS, in_way
from cart_poles import require_native_pool
from measure import Effort, MissingError, Run, by_turns, make_runs, repeated
from tables import Table, duration, times

import fmugym
from fmugym.environment.interface import resolve
from fmugym.environment.vector.task_programs import compile_formulas, formulas_of
from fmugym.expressions.program import OPERATIONS, is_function

__all__ = ["TASKS", "Task", "fmugym_run", "tables"]

SIZES = (1, 8, 64, 1024, 4096)
TITLE = (
    "Tasks, one thread: time of a step of all environments; in brackets, how many times faster\n"
    "than by hand in numpy, without the time of the FMUs themselves"
)
STEPS = 256
"""The steps that are repeated: at least one episode of most tasks."""

_ALLOWED_CALL = 6e-6
"""The time in s that a call of ``step`` may take beyond what it takes for each environment."""

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
            makers = dict(_makers(stack, task, size, 2 * c_limit.BLOCK if effort.quick else STEPS))
            runs, missing = make_runs(makers)
            blocks = by_turns(runs, effort)
            columns.append(({name: _call_time(blocks[name]) for name in runs}, missing, size))
    for name in makers:
        cells = [_cell(name, seconds, missing) for seconds, missing, _ in columns]
        table.rows.append([f"{task.name}: {name}", *cells])
    each = _allowed_each(task)
    if each is not None:
        cells = [_rest(seconds, size, each) for seconds, _, size in columns]
        table.rows.append([f"{task.name}: fmugym without the FMUs / allowed", *cells])
    table.data += [
        {"task": task.name, "way": name, "num_envs": size, "call_s": taken}
        for seconds, _, size in columns
        for name, taken in seconds.items()
    ]


def _allowed_each(task: Task) -> float | None:
    """The time in s that an environment may take beyond its FMU, according to its programs.

    None if the task has hooks.
    """
    with ExitStack() as stack:
        env = _fmugym(stack, task, 1).prototype
        formulas = formulas_of(env)
        if formulas is None:
            return None
        programs = compile_formulas(env, formulas)
    codes = np.concatenate([programs.inputs.code[:, 0], programs.conclusion.code[:, 0]])
    names = [OPERATIONS[code] for code in codes.tolist()]
    return 1e-9 * (10.0 + sum(map(_allowed, names)))


def _allowed(operation: str) -> float:
    """The time in ns that an operation may take; moving values belongs to the environment."""
    if operation.startswith(("load_", "store_")):
        return 0.0
    if operation.startswith("power"):
        return 60.0
    return 30.0 if is_function(operation) else 1.0


def _rest(seconds: dict[str, float], size: int, each: float) -> str:
    """What a call costs beyond the FMUs, and what it may cost."""
    return f"{duration(seconds['fmugym'] - seconds[FMU])} / {duration(_ALLOWED_CALL + each * size)}"


Blocks = list[float]
"""The time of each ``BLOCK`` calls of ``step`` in s."""


def _call_time(turns: list[Blocks]) -> float:
    """The time of a call, from the least times of each block in all turns."""
    return sum(map(min, zip(*turns, strict=True))) / (len(turns[0]) * c_limit.BLOCK)


def _makers(
    stack: ExitStack, task: Task, size: int, steps: int
) -> Iterator[tuple[str, Callable[[], Callable[[float], Blocks]]]]:
    yield FMU, lambda: _fmu_run(stack, task, size, steps)
    yield "fmugym", lambda: _blocks(_fmugym(stack, task, size), steps)
    yield "hooks on arrays", lambda: _blocks(_fmugym(stack, task, size, ARRAYS), steps)
    yield BY_HAND, lambda: _blocks(_by_hand(stack, task, size), steps)
    for name in MOST:
        yield name, lambda name=name: _blocks(_gymnasium(stack, task, size, name), steps)


def _fmugym(stack: ExitStack, task: Task, size: int, way: str | None = None) -> Any:
    envs = fmugym.FMUVectorEnv(
        in_way(way, task.make), size, max_episode_steps=task.limit, threads=1
    )
    stack.callback(envs.close)
    return envs


def fmugym_run(stack: ExitStack, make: Callable[[], fmugym.FMUEnv], size: int) -> Run:
    """Count calls of ``step`` of a vector environment of this package on one thread."""
    envs = fmugym.FMUVectorEnv(make, size, max_episode_steps=500, threads=1)
    stack.callback(envs.close)
    actions = _actions(envs)
    envs.reset(seed=0)

    def block() -> None:
        for action in actions:
            envs.step(action)

    return repeated(block, len(actions))


def _by_hand(stack: ExitStack, task: Task, size: int) -> by_hand.ByHand:
    env = task.make()
    stack.callback(env.close)
    envs = task.by_hand(env, size, task.limit)
    stack.callback(envs.close)
    return envs


def _gymnasium(stack: ExitStack, task: Task, size: int, name: str) -> Any:
    if size > MOST[name]:
        raise MissingError("-")
    options = {"context": "fork"} if name == "AsyncVectorEnv" else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        make = partial(gym.wrappers.TimeLimit, max_episode_steps=task.limit)
        envs = getattr(gym.vector, name)([lambda: make(task.make())] * size, **options)
    stack.callback(envs.close)
    return envs


def _actions(envs: Any) -> list[Any]:
    """Random actions for the calls of a block."""
    envs.action_space.seed(0)
    return [envs.action_space.sample() for _ in range(c_limit.BLOCK)]


def _blocks(envs: Any, steps: int) -> Callable[[float], Blocks]:
    """Play the same steps until the time is over; return the least time of each block."""
    actions = _actions(envs)
    start = envs.reset if isinstance(envs, by_hand.ByHand) else partial(envs.reset, seed=0)

    def run(seconds: float) -> Blocks:
        end, least = time.perf_counter() + seconds, [np.inf] * (steps // len(actions))
        while least[-1] == np.inf or time.perf_counter() < end:
            start()
            for index, before in enumerate(least):
                begin = time.perf_counter()
                for action in actions:
                    envs.step(action)
                least[index] = min(before, time.perf_counter() - begin)
        return least

    return run


def _fmu_run(stack: ExitStack, task: Task, size: int, steps: int) -> Callable[[float], Blocks]:
    """Repeat what the FMUs did in the steps that are played by hand."""
    with ExitStack() as played:
        envs = _by_hand(played, task, size)
        loop = _loop_of(envs.env)
        record = c_limit.build_folder() / f"{task.name}-{size}.steps"
        rows = [[v.name for v in envs.parameters].index(name) for name in loop.starts]
        record.write_bytes(b"".join(_recorded(envs, rows, steps)))
    stack.callback(record.unlink)
    return partial(c_limit.repeat, loop, size, record)


def _recorded(envs: by_hand.ByHand, rows: list[int], steps: int) -> Iterator[bytes]:
    """What ``c_limit.c`` reads, in its order; the rows are those of start values."""
    actions = _actions(envs)
    yield np.array([envs.num_envs, steps, len(rows)], np.int64).tobytes()
    envs.reset()
    yield envs.values[rows].T.tobytes()
    for index in range(steps):
        starting = envs.ended
        envs.step(actions[index % len(actions)])
        yield starting.tobytes()
        yield envs.pool.inputs.T.tobytes()
        yield envs.values[rows][:, starting].T.tobytes()


def _loop_of(env: fmugym.FMUEnv) -> c_limit.Loop:
    """What a bare C program has to do to step this environment's FMU."""
    config, reals, others = env.config, {}, {}
    for name, value in resolve(config, env.fmu.description).parameters.items():
        if env.fmu.variable(name).kind == "real":
            reals[name] = 0.0  # the record has the value
        else:
            others[name] = int(value)
    return c_limit.Loop(
        env.fmu,
        config.time_step,
        dict.fromkeys(config.model_input_names, 0.0),
        dict.fromkeys(config.model_output_names, np.inf),
        reals,
        others,
    )


def _cell(name: str, seconds: dict[str, float], missing: dict[str, str]) -> str:
    if name not in seconds:
        return missing.get(name, "-")
    own = seconds[name]
    if name == FMU:
        return duration(own)
    return f"{duration(own)} ({times((seconds[BY_HAND] - seconds[FMU]) / (own - seconds[FMU]))})"
