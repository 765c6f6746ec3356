"""Evaluation of players: all play the same episodes, with a score for each."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, field
from itertools import compress
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np

from fmugym.control.candidate_evaluation import most_steps_of
from fmugym.environment.env import FMUEnv
from fmugym.errors import plain
from fmugym.extras import imported
from fmugym.files import replaced
from fmugym.records.episode_statistics import confidence
from fmugym.records.players import Player, Policy, Summary, simulate
from fmugym.records.progress_bars import Advance, no_progress

__all__ = [
    "HELD_OUT_SEED",
    "Score",
    "aligned",
    "evaluate",
    "plot_scores",
    "table",
    "warning_of_one_reward",
]

HELD_OUT_SEED: Final = 1_000_000
"""Episodes of tests and evaluations have seeds from here on, which no training uses."""

_LEAST_WIDTH: Final = 0.01
"""The least width of an axis, as a fraction of its largest value."""

_LONGEST_LABEL: Final = 48

_RANDOM: Final = "random"
"""The name of random actions, beside which nobody wants to know a gain."""

Wrap = Callable[[FMUEnv], Any]
"""Puts wrappers around an environment."""


@dataclass(frozen=True)
class Score:
    """Result of a player in some episodes.

    Attributes:
        name: The controller.
        rewards: The total reward of each episode.
        costs: The total cost of each episode; empty if the task has none.
        steps: The number of steps of each episode.
        ends: How often an episode ended in which way; faults are counted together.
        real_time_factor: Simulated seconds in a second of real time, the controller included.
        scenario: The scenario of the episodes; None for those of the task.
        kpis: The KPIs of the episodes that have reported some, by name.
        only_reward: The reward of every step of all episodes; None if it has changed.
        gains: How much more reward each episode has brought than the same episode of the first
            player, random actions aside; empty for those two.
    """

    name: str
    rewards: tuple[float, ...]
    costs: tuple[float, ...]
    steps: tuple[int, ...]
    ends: Mapping[str, int]
    real_time_factor: float
    scenario: str | None = None
    kpis: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    only_reward: float | None = None
    gains: tuple[float, ...] = ()

    @property
    def mean(self) -> float:
        """The mean reward."""
        return float(np.mean(self.rewards))

    def as_dict(self) -> dict[str, Any]:
        """The numbers in types that JSON has."""
        return asdict(self) | {
            "mean_reward": self.mean,
            "interval_95": _interval(self.rewards),
            "mean_cost": float(np.mean(self.costs)) if self.costs else None,
            "cost_interval_95": _interval(self.costs),
            "mean_gain": float(np.mean(self.gains)) if self.gains else None,
            "gain_interval_95": _interval(self.gains),
            "mean_kpis": {name: float(np.mean(values)) for name, values in self.kpis.items()},
        }


def _interval(values: Sequence[float]) -> list[float] | None:
    half = confidence(values)
    mean = float(np.mean(values)) if values else 0.0
    return None if half is None else [mean - half, mean + half]


def evaluate(
    make_env: Callable[..., FMUEnv],
    players: Mapping[str, Player],
    seeds: Iterable[int],
    most_steps: int,
    scenario: str | None = None,
    advance: Advance = no_progress,
    wrap: Wrap = lambda env: env,
    periods: Sequence[tuple[float, int]] = (),
    leave_out: Callable[[str, Exception], None] | None = None,
) -> Iterator[Score]:
    """Let players play the same episodes.

    Args:
        make_env: A function that makes the environment; see ``Player.make_env``.
        players: Players by name.
        seeds: The seeds of the episodes.
        most_steps: The steps after which an episode is stopped.
        scenario: The scenario that the environment plays, for the scores.
        advance: Is told of each step, as a part of an episode.
        wrap: Puts wrappers around the environment, such as a recorder.
        periods: Start times and numbers of steps of the episodes, one for each seed, if the task
            draws its start time.
        leave_out: Is told of a player that cannot play to the end, by name and with the reason; the
            others play all the same. By default what it raises comes out.

    Yields:
        A score for each player, in their order, as soon as it is known.
    """
    seeds, first = list(seeds), tuple[float, ...]()
    own: list[tuple[float | None, int]] = [(None, most_steps)] * len(seeds)
    with ExitStack() as stack:
        envs: dict[bool, Any] = {}  # by whether they are in the physical form
        policies: dict[str, Policy] = {}
        for name, player in players.items():  # so that no mistake comes up after another has played
            if player.is_physical not in envs:
                env = stack.enter_context(closing(player.make_env(make_env)))
                envs[player.is_physical] = stack.enter_context(closing(wrap(env)))
            with _leaving_out(name, leave_out):
                policies[name] = player.make_policy(envs[player.is_physical].unwrapped)
        for name, policy in policies.items():
            played, begin = envs[players[name].is_physical], perf_counter()
            episodes: list[Summary] = []
            try:
                with _leaving_out(name, leave_out):
                    for seed, (start, steps) in zip(seeds, periods or own, strict=True):
                        episodes.append(_played(played, policy, seed, steps, advance, start))
            except KeyboardInterrupt:
                if episodes:
                    yield _score(name, episodes, perf_counter() - begin, scenario, first)
                raise
            if len(episodes) < len(seeds):  # it is left out
                continue
            score = _score(name, episodes, perf_counter() - begin, scenario, first)
            yield score
            first = first or (score.rewards if name != _RANDOM else ())


@contextmanager
def _leaving_out(name: str, leave_out: Callable[[str, Exception], None] | None) -> Iterator[None]:
    """Tell of an error in a block, if somebody wants to know, instead of raising it."""
    try:
        yield
    except Exception as error:
        if leave_out is None:
            raise
        leave_out(name, error)


def _played(
    env: Any, policy: Policy, seed: int, steps: int, advance: Advance, start: float | None
) -> Summary:
    """Play an episode, and tell which part of it each step is."""
    part = 1 / min(steps, most_steps_of(env.unwrapped) or steps)
    summary = simulate(env, policy, seed, steps, lambda count: advance(count * part), start)
    advance(max(0.0, 1 - summary.steps * part))
    return summary


def _score(
    name: str,
    episodes: Sequence[Summary],
    took: float,
    scenario: str | None,
    first: Sequence[float],
) -> Score:
    ends = ["fault" if one.end.startswith("fault") else one.end for one in episodes]
    names = dict.fromkeys(kpi for one in episodes for kpi in one.kpis)
    return Score(
        name,
        tuple(one.total_reward for one in episodes),
        tuple(one.total_cost for one in episodes if one.total_cost is not None),
        tuple(one.steps for one in episodes),
        {end: ends.count(end) for end in dict.fromkeys(ends)},
        sum(one.seconds for one in episodes) / took,
        scenario,
        {n: tuple(one.kpis[n] for one in episodes if n in one.kpis) for n in names},
        _only(one.only_reward for one in episodes),
        tuple(one.total_reward - other for one, other in zip(episodes, first, strict=False)),
    )


def _only(values: Iterable[float | None]) -> float | None:
    """The value that all have; None if they differ."""
    found = set(values)
    return found.pop() if len(found) == 1 else None


def warning_of_one_reward(scores: Sequence[Score]) -> str | None:
    """Say that a reward has never changed, so that there may be nothing to learn.

    Args:
        scores: Scores of one evaluation.

    Returns:
        A line of text; None if rewards differ, or so do the lengths of episodes with rewards.
    """
    reward = _only(score.only_reward for score in scores)
    lengths = {steps for score in scores for steps in score.steps}
    if reward is None or (reward and len(lengths) > 1):
        return None
    return (
        f"the reward was {reward:g} in every step of the first evaluation: agents learn from "
        "differences, so say in the task what is better and what is worse"
    )


def table(scores: Sequence[Score]) -> str:
    """Format scores for a terminal: lines of printable ASCII, without empty columns."""
    kpis = tuple(dict.fromkeys(name for score in scores for name in score.kpis))
    names = "reward", "+-", "gain", "+-", "cost", "steps", "ends", *map(plain, kpis), "x real time"
    rows = [_row(*pair, kpis) for pair in zip(_labels(scores), scores, strict=True)]
    has = [any(column) for column in zip(*rows, strict=True)]
    return "\n".join(aligned([[*compress(row, has)] for row in [("", *names), *rows]]))


def aligned(rows: Sequence[Sequence[str]], widest: int = sys.maxsize) -> list[str]:
    """The lines of a table whose cells stand below each other, up to a width of a column."""
    widths = [min(widest, max(map(len, column))) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def _labels(scores: Sequence[Score]) -> list[str]:
    """The controllers, and the scenarios if there are several."""
    if len({score.scenario for score in scores}) < 2:
        return [plain(score.name) for score in scores]
    return [plain(f"{score.name} ({score.scenario})") for score in scores]


def _row(label: str, score: Score, kpis: Sequence[str]) -> tuple[str, ...]:
    return (
        label,
        *_mean_and_half(score.rewards),
        *_mean_and_half(score.gains),
        f"{np.mean(score.costs):.6g}" if score.costs else "",
        f"{np.mean(score.steps):.6g}",
        ", ".join(f"{count} {end}" for end, count in score.ends.items()),
        *(f"{np.mean(score.kpis[name]):.6g}" if name in score.kpis else "" for name in kpis),
        f"{score.real_time_factor:.3g}",
    )


def _mean_and_half(values: Sequence[float]) -> tuple[str, str]:
    half = confidence(values)
    mean = f"{np.mean(values):.6g}" if values else ""
    return mean, "" if half is None else f"{half:.3g}"


def plot_scores(scores: Sequence[Score], path: Path, title: str) -> None:
    """Draw rewards, gains and costs: each episode, the mean, and its 95 % confidence interval.

    Random actions are left out beside two others or more if they are worse than all of these: often
    by so much that the others could not be told apart.

    Args:
        scores: The scores.
        path: The file to write.
        title: A line of text above.

    Raises:
        ConfigError: If Matplotlib is missing.
    """
    figures: Any = imported("matplotlib.figure", "plot")
    scores = _worth_drawing(scores)
    groups = {"reward of an episode": [score.rewards for score in scores]}
    if any(score.gains for score in scores):
        first = next(score.name for score in scores if score.name != _RANDOM)
        groups[f"gain beside\n{_shortened(first)}"] = [score.gains for score in scores]
    if all(score.costs for score in scores):
        groups["cost of an episode"] = [score.costs for score in scores]
    figure = figures.Figure(
        figsize=(3.0 + 3.2 * len(groups), 1.4 + 0.42 * len(scores)), layout="constrained"
    )
    axes = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axis, (label, values) in zip(axes, groups.items(), strict=True):
        if label.startswith("gain"):
            axis.axvline(0.0, color="#333333", linewidth=0.8)
        _draw_scores(axis, values)
        axis.set_xlabel(label)
    axes[0].set_yticks(range(len(scores)), list(map(_shortened, _labels(scores))))
    axes[0].invert_yaxis()
    figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    with replaced(path) as part:
        figure.savefig(part, dpi=150)


def _worth_drawing(scores: Sequence[Score]) -> Sequence[Score]:
    others = [score for score in scores if score.name != _RANDOM]
    randoms = [np.mean(score.rewards) for score in scores if score.name == _RANDOM]
    if not randoms or len({score.name for score in others}) < 2:
        return scores
    return others if max(randoms) < min(np.mean(score.rewards) for score in others) else scores


def _shortened(text: str) -> str:
    shown = text.replace("$", r"\$")
    return shown if len(shown) <= _LONGEST_LABEL else f"{shown[: _LONGEST_LABEL - 3]}..."


def _draw_scores(axis: Any, groups: Sequence[Sequence[float]]) -> None:
    for row, values in enumerate(groups):
        if not values:
            continue
        axis.plot(values, [row] * len(values), "o", color="#9aa5ae", markersize=4, alpha=0.6)
        half = confidence(values) or 0.0
        style = {"capsize": 4, "markersize": 6, "linewidth": 1.6}
        axis.errorbar(np.mean(values), row, xerr=half, fmt="o", color="#0072b2", **style)
    _widen(axis)
    axis.set_ylim(-0.6, len(groups) - 0.4)
    axis.grid(axis="x", color="#e4e4e4")
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def _widen(axis: Any) -> None:
    """Let nearly equal values look nearly equal, and give each tick its whole number."""
    low, high = axis.get_xlim()
    center, width = (low + high) / 2.0, max(high - low, _LEAST_WIDTH * max(abs(low), abs(high)))
    axis.set_xlim(center - width / 2.0, center + width / 2.0)
    axis.ticklabel_format(axis="x", useOffset=False)
