"""Evaluation of a shadow's log (``evaluate --log``): the plant, compared with other players."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from fmugym.declared import Task, load
from fmugym.episodes.evaluation import HELD_OUT_SEED, Score, evaluate
from fmugym.episodes.progress_bars import Advance
from fmugym.episodes.simulation import Player, Policy
from fmugym.logs import PlantLog, as_logged, play_log
from fmugym.recording import Recording

__all__ = ["evaluate_log"]


class _Costs(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Adds up the costs of episodes."""

    def __init__(self, env: Any, totals: list[float]) -> None:
        super().__init__(env)
        self._totals = totals

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        self._totals.append(0.0)
        return self.env.reset(**arguments)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        found = self.env.step(action)
        self._totals[-1] += float(found[-1].get("cost", 0.0))
        return found


def evaluate_log(
    task: Task,
    log: PlantLog,
    players: Mapping[str, Player],
    advance: Advance,
    leave_out: Callable[[str, Exception], None] | None = None,
) -> Iterator[Score]:
    """Compare the plant's results with other players on the FMU in the same periods.

    Args:
        task: The task.
        log: The record of a shadow, whose times are seconds of the year.
        players: Players on the FMU.
        advance: Is told of each step on the FMU, as a part of all.
        leave_out: See ``evaluate``.

    Yields:
        The score of the plant, as it was measured; those of the FMU with the actions that acted and
        that were proposed; and those of the players.

    Raises:
        ConfigError: If the log does not fit the task.
    """
    task = as_logged(task, log)
    costs: list[float] = []
    recordings = play_log(log, lambda **more: _Costs(load(task, physical=True, **more), costs))
    yield Score(
        "plant, measured",
        tuple(float(one.rewards.sum()) for one in recordings),
        tuple(costs) if "costs" in task.document else (),
        tuple(map(len, recordings)),
        {"measured": len(recordings)},
        1.0,
    )
    acted = {"actions of the plant": _replayed(recordings)}
    if log.proposed is not None:
        proposals = play_log(log.proposed, partial(load, task, physical=True))
        acted["proposed actions"] = _replayed(proposals)
    periods = [(one.drawn["start_time"], len(one)) for one in recordings]
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + len(periods))
    most = max(map(len, recordings))
    players = {**acted, **players}
    count = len(periods) * len(players)
    yield from evaluate(
        partial(load, task),
        players,
        seeds,
        most,
        None,
        lambda part: advance(part / count),
        periods=periods,
        leave_out=leave_out,
    )


def _replayed(recordings: Sequence[Recording]) -> Player:
    """Player that repeats logged actions, episode by episode."""
    left: Iterator[np.ndarray[Any, Any]] = iter(())
    each = iter(recordings)

    def begin() -> None:
        nonlocal left
        left = iter(next(each).actions)

    return Player(lambda env: Policy(lambda observation: next(left), begin), is_physical=True)
