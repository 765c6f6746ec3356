"""Measure how planning compares with agents and tuned controllers, in the same episodes."""

from __future__ import annotations

import logging
import statistics
import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from measure import Effort
from tables import Table, duration
from training import Goal, train, write_plants

import fmugym
from fmugym.control import MPC, controller_of
from fmugym.envs.house import HOUSE_TASK
from fmugym.records.episode_statistics import confidence
from fmugym.records.evaluation import HELD_OUT_SEED, Score, evaluate
from fmugym.records.players import Player, policy_of_controller
from fmugym.training.agents import agent_player

__all__ = ["tables"]

FORECAST = [
    {"of": ["T_set", "price"], "horizon": "12h", "step": "2h"},
    {"of": ["T_out"], "horizon": "12h", "step": "2h", "error": 2.0},
    {"of": ["sun"], "horizon": "12h", "step": "2h", "error": {"std": 0.3, "relative": True}},
]
SOLVED = {"solver": "explicit_euler", "max_step": 300.0}
LOSES_MORE = {"H_ve": 72.0, "H_op": 120.0, "H_w": 48.0}
"""The heat that the house of the model loses, in W/K: 20 % more."""


class Case(NamedTuple):
    """A task, and how its plans are made.

    Attributes:
        task: Its file.
        time_step: The length of a step in s.
        horizon: How far plans go.
        candidates: How many a decision tries.
        episodes: How many are played, in each scenario if there are some.
        scenarios: Their names; None for the task's own episodes.
    """

    task: str
    time_step: float
    horizon: str
    candidates: int
    episodes: int
    scenarios: Sequence[str | None] = (None,)


CASES = (
    Case("house.toml", 900.0, "24h", 256, 1, ("autumn", "frost", "spring")),
    Case("drive.toml", 0.01, "300ms", 32, 3),
    Case("room.toml", 900.0, "24h", 32, 3),
)
HEADER = ["task, controller", "reward", "beside PI", "+-", "time of a step"]


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    table = Table("Rewards in the same test episodes, summed over scenarios", HEADER)
    with tempfile.TemporaryDirectory() as folder:
        write_plants(Path(folder))
        _write_house(Path(folder))
        for case in CASES[1:2] if effort.quick else CASES:
            _measure(table, case, Path(folder), effort.quick)
    return [table]


def _write_house(folder: Path) -> None:
    """The house with errors of its forecasts, and a model of it that loses more heat."""
    task = dict(fmugym.Task.read(HOUSE_TASK).with_paths(lambda path: path))
    task["agent"] = {**task["agent"], "forecast": FORECAST}
    for name, more in (("house", SOLVED), ("house_model", {**SOLVED, **LOSES_MORE})):
        given = {**task, "parameters": {**task["parameters"], **more}}
        fmugym.Task.from_dict(given, folder).write(folder / f"{name}.toml")


def _measure(table: Table, case: Case, folder: Path, quick: bool) -> None:
    """Train an agent, and let it play beside the tuned controller and plans."""
    facts = train(Goal(case.task, None, 1.0), 0, folder, quick)
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + (1 if quick else case.episodes))
    found: dict[str, list[Score]] = {}
    for scenario in case.scenarios:
        options = {"scenario": scenario, "log_level": logging.ERROR}
        make = partial(fmugym.load, folder / case.task, **options)
        players = _players(case, folder, facts, scenario)
        for score in evaluate(make, players, seeds, 2 if quick else 10_000, scenario):
            found.setdefault(score.name, []).append(score)
    name = Path(case.task).stem
    for player, scores in found.items():
        table.rows.append([f"{name}, {player}", *_figures(scores, case.time_step)])
        table.data += [{"task": name, **score.as_dict()} for score in scores]


def _players(
    case: Case, folder: Path, facts: Mapping[str, Any], scenario: str | None
) -> dict[str, Any]:
    """Those who act, by name; gains are beside the first one."""
    pi = facts["controller"]
    plans: dict[str, dict[str, Any]] = {"MPC": {}, "perfect MPC": {"perfect": True}}
    model = folder / f"{Path(case.task).stem}_model.toml"
    if model.exists():
        plans["MPC, model 20 % off"] = {"model": partial(fmugym.load, model, scenario=scenario)}
    acting = {"tuned PI": controller_of(pi)} | {
        name: MPC(case.horizon, case.candidates, warm=controller_of(pi), **options)
        for name, options in plans.items()
    }
    players = {
        name: Player(partial(policy_of_controller, one), is_physical=True)
        for name, one in acting.items()
    }
    return players | {"agent": agent_player(Path(facts["folder"]))}


def _figures(scores: Sequence[Score], time_step: float) -> list[str]:
    """The reward, the gain and half of its interval, and the time of a step."""
    gains = [sum(each) for each in zip(*(score.gains for score in scores), strict=True)]
    half = confidence(gains)
    took = statistics.mean(time_step / score.real_time_factor for score in scores)
    return [
        f"{sum(score.mean for score in scores):.4g}",
        f"{statistics.mean(gains):.3g}" if gains else "",
        "" if half is None else f"{half:.2g}",
        duration(took),
    ]
