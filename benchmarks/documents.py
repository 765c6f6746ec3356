"""Measure the tables of the documentation, and print them as they stand there."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import cart_poles
import gymnasium as gym
import planning
import single
import tasks
import training
import vector
from calling import ARRAYS, EACH, in_way
from gate_rows import CartPoleOnArrays
from gymnasium.envs.registration import EnvSpec
from measure import Effort, Run, Sample, by_turns, make_runs
from tables import Table
from user_tasks import Tracking

from fmugym.envs import CartPoleEnv

__all__ = ["DOCUMENTS"]

LEFT_OUT = {
    "fmugym, DISABLED, 2 threads",
    "Gymnasium AsyncVectorEnv",
    "EnvPool, 2 threads",
}
"""Rows of the section ``vector`` for which the README has no room."""

SIZES = (1, 8, 64, 1024)


class CartPoleOfOne(CartPoleOnArrays):
    """The cart-pole with hooks as one writes them for a single environment."""

    def _get_inputs(self) -> Any:
        return 10.0 if self.action == 1 else -10.0

    def _is_done(self) -> Any:
        x, _, phi, _ = self.state
        return abs(x) > 2.4 or abs(phi) > 0.2094

    def _reward_policy(self) -> Any:
        return 0.0 if self.after_end else 1.0


def _readme(effort: Effort) -> list[Table]:
    """The tables of the section "Speed" of the README."""
    steps = vector.tables(effort)[0]
    steps.rows = [row for row in steps.rows if row[0] not in LEFT_OUT]
    return [*single.tables(effort), steps]


def _vector(effort: Effort) -> list[Table]:
    """The table of docs/vector.md."""
    sizes = SIZES[:2] if effort.quick else SIZES
    title = "Processor time of a call of step on one thread in us"
    table = Table(title, ["environments", *map(str, sizes)])
    logging.getLogger("fmugym.environment.vector").setLevel(
        logging.ERROR
    )  # it warns of hooks one by one
    cells = [_times_of_ways(size, effort) for size in sizes]
    table.rows = [[name, *(cell[name] for cell in cells)] for name in cells[0]]
    return [table]


def _times_of_ways(size: int, effort: Effort) -> dict[str, str]:
    """Of a call of ``step``, by the way in which hooks are called."""
    ways: dict[str, tuple[Callable[[], Any], str | None]] = {
        "a cart-pole of expressions": (CartPoleEnv, None),
        "the same, hooks on arrays": (CartPoleOnArrays, ARRAYS),
        "the same, hooks one by one": (CartPoleOnArrays, EACH),
        "a [tracking task](hooks.md#remember-something-during-an-episode), hooks on arrays": (
            Tracking,
            ARRAYS,
        ),
    }
    with ExitStack() as stack:
        samples = by_turns(
            {
                name: tasks.fmugym_run(stack, in_way(way, make), size)
                for name, (make, way) in ways.items()
            },
            effort,
        )
    return {name: f"{_fastest(own) * 1e6:.0f}" for name, own in samples.items()}


def _fastest(samples: list[Sample]) -> float:
    """The processor time of a call in the fastest turn: other work does not slow that down."""
    return min(sample.cpu / sample.count for sample in samples)


def _hooks(effort: Effort) -> list[Table]:
    """Another table of docs/vector.md."""
    title = "Processor time of a step of gymnasium.make in us, resets included"
    with ExitStack() as stack:
        runs, _ = make_runs(_single_makers(stack))
        samples = by_turns(runs, effort)
    row = ["a cart-pole", *(f"{_fastest(own) * 1e6:.1f}" for own in samples.values())]
    return [Table(title, ["", *samples], [row])]


def _single_makers(stack: ExitStack) -> dict[str, Callable[[], Run]]:
    def make(env_id: Any) -> Run:
        env = gym.make(env_id, disable_env_checker=True)
        stack.callback(env.close)
        env.action_space.seed(0)
        return cart_poles.environment_run(env, [env.action_space.sample() for _ in range(512)])

    def of(entry_point: Any) -> EnvSpec:
        return EnvSpec("benchmarks/CartPole-v0", entry_point, max_episode_steps=500)

    return {
        "expressions": lambda: make("fmugym/CartPole-v0"),
        "hooks in Python": lambda: make(of(CartPoleOfOne)),
        "those that take arrays, too": lambda: make(of(CartPoleOnArrays)),
        "Gymnasium's own": lambda: make("CartPole-v1"),
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
