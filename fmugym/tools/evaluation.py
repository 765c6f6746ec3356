"""Agents and simple controllers side by side: the same episodes, and what each makes of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Any, Final

import numpy as np

from fmugym.env import FMUEnv
from fmugym.tools.overview import plain
from fmugym.tools.simulation import Policy, Summary, simulate

__all__ = ["Score", "confidence", "evaluate", "table"]

_Z: Final = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""


@dataclass(frozen=True)
class Score:
    """What a controller reached in some episodes.

    Attributes:
        name: The controller.
        rewards: The total reward of each episode.
        costs: The total cost of each episode; empty if the task has none.
        steps: The number of steps of each episode.
        ends: How often an episode ended in which way; faults are counted together.
        real_time_factor: Simulated seconds in a second of real time, the controller included.
    """

    name: str
    rewards: tuple[float, ...]
    costs: tuple[float, ...]
    steps: tuple[int, ...]
    ends: Mapping[str, int]
    real_time_factor: float

    @property
    def mean(self) -> float:
        """The mean reward."""
        return float(np.mean(self.rewards))

    def as_dict(self) -> dict[str, Any]:
        """The numbers in types that JSON has."""
        half = confidence(self.rewards)
        mean_cost = float(np.mean(self.costs)) if self.costs else None
        interval = None if half is None else [self.mean - half, self.mean + half]
        derived = {"mean_reward": self.mean, "interval_95": interval, "mean_cost": mean_cost}
        return asdict(self) | derived


def confidence(values: Sequence[float]) -> float | None:
    """Half the width of the 95 % confidence interval of a mean, by Student's distribution.

    Returns:
        The number; None for fewer than two values.
    """
    count = len(values)
    if count < 2:
        return None
    return _student(count - 1) * float(np.std(values, ddof=1)) / math.sqrt(count)


def _student(freedom: int) -> float:
    """The 97.5 % quantile of Student's distribution.

    For one and two degrees of freedom it is a closed form. For more, see Abramowitz and Stegun,
    "Handbook of Mathematical Functions", 26.7.5; the error is below 1 %.
    """
    if freedom == 1:
        return math.tan(math.pi * 0.475)
    if freedom == 2:
        return 0.95 * math.sqrt(2.0 / (1.0 - 0.95 * 0.95))
    z = _Z
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    total: float = sum(term / freedom**power for power, term in enumerate(terms, 1))
    return z + total


def evaluate(
    make_env: Callable[[], FMUEnv],
    policies: Mapping[str, Callable[[FMUEnv], Policy]],
    seeds: Iterable[int],
    most_steps: int,
) -> list[Score]:
    """Let controllers play the same episodes.

    Args:
        make_env: A function that makes the environment.
        policies: By name, functions that make a policy for an environment.
        seeds: The seeds of the episodes.
        most_steps: The steps after which an episode is stopped.

    Returns:
        A score for each controller, in their order.
    """
    seeds, scores = list(seeds), []
    env = make_env()
    try:
        for name, make_policy in policies.items():
            policy, begin = make_policy(env), perf_counter()
            episodes = [simulate(env, policy, seed, most_steps) for seed in seeds]
            scores.append(_score(name, episodes, perf_counter() - begin))
    finally:
        env.close()
    return scores


def _score(name: str, episodes: Sequence[Summary], took: float) -> Score:
    ends = ["fault" if one.end.startswith("fault") else one.end for one in episodes]
    return Score(
        name,
        tuple(one.total_reward for one in episodes),
        tuple(one.total_cost for one in episodes if one.total_cost is not None),
        tuple(one.steps for one in episodes),
        {end: ends.count(end) for end in dict.fromkeys(ends)},
        sum(one.seconds for one in episodes) / took,
    )


def table(scores: Sequence[Score]) -> str:
    """Format scores for a terminal: lines of printable ASCII."""
    header = ("", "reward", "+-", "cost", "steps", "ends", "x real time")
    rows = [header, *(_row(score) for score in scores)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _row(score: Score) -> tuple[str, ...]:
    half = confidence(score.rewards)
    return (
        plain(score.name),
        f"{score.mean:.6g}",
        "" if half is None else f"{half:.3g}",
        f"{np.mean(score.costs):.6g}" if score.costs else "",
        f"{np.mean(score.steps):.6g}",
        ", ".join(f"{count} {end}" for end, count in score.ends.items()),
        f"{score.real_time_factor:.3g}",
    )
