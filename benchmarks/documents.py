"""Measure the tables of the documentation, and print them as they stand there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack

import cart_poles
import gymnasium as gym
import planning
import single
import tasks
import training
import vector
from calling import ARRAYS, in_python
from measure import Effort, Run, Sample, by_turns, make_runs
from tables import Table

__all__ = ["DOCUMENTS"]

LEFT_OUT = {
    "fmugym, DISABLED, 2 threads",
    "Gymnasium AsyncVectorEnv",
    "EnvPool, 2 threads",
}
"""Rows of the section ``vector`` for which the README has no room."""

TASKS = {
    "`CartPole-v0`": "CartPole-v0",
    "`Pendulum-v0`": "Pendulum-v0",
    "`CloudPendulum-v0`": "CloudPendulum-v0",
    "a [tracking task](hooks.md#remember-something-during-an-episode)": "tracking",
}
WAYS = (None, ARRAYS)
SIZES = (1, 8, 64, 1024)
PER_ENV_SIZES = (64, 512, 1024)


def _readme(effort: Effort) -> list[Table]:
    """The tables of the section "Speed" of the README."""
    steps = vector.tables(effort)[0]
    steps.rows = [row for row in steps.rows if row[0] not in LEFT_OUT]
    return [*single.tables(effort), steps]


def _vector(effort: Effort) -> list[Table]:
    """The table of docs/vector.md."""
    sizes = SIZES[:2] if effort.quick else SIZES
    title = "Processor time of a call of step on one thread in us, expressions / hooks on arrays"
    return [_of_tasks(title, "environments", sizes, _two_ways, effort)]


def _of_tasks(
    title: str,
    corner: str,
    sizes: Sequence[int],
    cell: Callable[[tasks.Task, int, Effort], str],
    effort: Effort,
) -> Table:
    """A table with a row for each task and a column for each size."""
    table = Table(title, [corner, *map(str, sizes)])
    known = {task.name: task for task in tasks.TASKS}
    for shown, name in TASKS.items():
        table.rows.append([shown, *(cell(known[name], size, effort) for size in sizes)])
    return table


def _two_ways(task: tasks.Task, size: int, effort: Effort) -> str:
    with ExitStack() as stack:
        ways = WAYS if _has_expressions(task) else WAYS[1:]
        runs = {way: tasks.fmugym_run(stack, task, size, way) for way in ways}
        samples = by_turns(runs, effort)
    return " / ".join(f"{_fastest(samples[way]) * 1e6:.0f}" for way in ways)


def _has_expressions(task: tasks.Task) -> bool:
    env = task.make()
    env.close()
    return env.inside.formulas is not None


def _fastest(samples: list[Sample]) -> float:
    """The processor time of a call in the fastest turn: other work does not slow that down."""
    return min(sample.cpu / sample.count for sample in samples)


def _hooks(effort: Effort) -> list[Table]:
    """A table of docs/vector.md, and what hooks cost that are called one by one."""
    table = Table(
        "Processor time of a step of gymnasium.make in us, resets included",
        ["", "expressions", "in Python", "Gymnasium's own"],
    )
    for name, theirs in (("CartPole-v0", "CartPole-v1"), ("Pendulum-v0", "Pendulum-v1")):
        with ExitStack() as stack:
            runs, _ = make_runs(_single_makers(stack, f"fmugym/{name}", theirs))
            samples = by_turns(runs, effort)
        table.rows.append(
            [f"`{name}`", *(f"{_fastest(own) * 1e6:.1f}" for own in samples.values())]
        )
    return [table, _per_env(effort)]


def _per_env(effort: Effort) -> Table:
    """What hooks cost that are called one environment at a time."""
    sizes = PER_ENV_SIZES[:1] if effort.quick else PER_ENV_SIZES
    title = "Processor time of a step per environment in us, all / hooks and FMUs alone"
    return _of_tasks(title, "one by one", sizes, _all_and_hooks, effort)


def _all_and_hooks(task: tasks.Task, size: int, effort: Effort) -> str:
    with ExitStack() as stack:
        runs = tasks.per_env_runs(stack, task, size)
        samples = by_turns(runs, effort)
    return " / ".join(f"{_fastest(own) * 1e6 / size:.1f}" for own in samples.values())


def _single_makers(stack: ExitStack, ours: str, theirs: str) -> dict[str, Callable[[], Run]]:
    def make(env_id: str, is_python: bool = False) -> Run:
        env = gym.make(env_id, disable_env_checker=True)
        if is_python:
            in_python(env.unwrapped)
        stack.callback(env.close)
        env.action_space.seed(0)
        return cart_poles.environment_run(env, [env.action_space.sample() for _ in range(512)])

    return {
        "expressions": lambda: make(ours),
        "python": lambda: make(ours, is_python=True),
        "Gymnasium": lambda: make(theirs),
    }


def _training(effort: Effort) -> list[Table]:
    """The table of docs/training.md, which tells in its text who reached what is wanted."""
    return [_without("reached by", table) for table in training.tables(effort)]


def _planning(effort: Effort) -> list[Table]:
    """The table of docs/training.md that has planning, too; times are told elsewhere."""
    return [_without("time of a step", table) for table in planning.tables(effort)]


def _without(column: str, table: Table) -> Table:
    place = table.header.index(column)
    table.header, *table.rows = (
        row[:place] + row[place + 1 :] for row in (table.header, *table.rows)
    )
    return table


DOCUMENTS: dict[str, Callable[[Effort], list[Table]]] = {
    "readme": _readme,
    "vector": _vector,
    "hooks": _hooks,
    "training": _training,
    "planning": _planning,
}
"""What measures the tables of the README and of pages of docs/."""
