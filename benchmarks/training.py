"""Measure what ``fmugym train`` reaches by itself, beside what each task asks for."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from measure import Effort
from tables import Table

__all__ = ["Goal", "tables", "train", "write_plants"]

HERE = Path(__file__).parent
SEEDS = range(5)

DRIVE = {
    "fmu": "Drive.fmu",
    "time_step": 0.01,
    "episode_length": 6,
    "variables": {
        "tau": {"min": -3, "max": 3},
        "w": {"name": "w_load", "min": -20, "max": 20},
        "w_motor": {"min": -20, "max": 20},
        "twist": {"min": -1, "max": 1},
    },
    "parameters": {"dry": {"distribution": "uniform", "low": 0.1, "high": 0.4}},
    "expressions": {"w_ref": {"expr": "5 * sin(time * 2)", "min": -5, "max": 5}},
    "agent": {"actions": ["tau"], "observations": ["w", "w_motor", "twist", "w_ref"]},
    "reward": "-(w - w_ref) ** 2 * dt",
}
ROOM = {
    "fmu": "Room.fmu",
    "time_step": "15min",
    "episode_length": "5d",
    "variables": {
        "heat": {"min": 0, "max": 3000},
        "T": {"min": 10, "max": 30},
        "T_wall": {"min": 10, "max": 30},
        "T_out": {"min": -20, "max": 30},
        "sun": {"min": 0, "max": 1500},
    },
    "parameters": {"T_mean": {"distribution": "uniform", "low": -4, "high": 6}},
    "expressions": {"price": {"expr": "0.3 + 0.1 * sin(time / 3600 * pi / 6)", "min": 0, "max": 1}},
    "setpoints": {"T_set": {"schedule": {"06:00": 21, "22:00": 18}}},
    "agent": {
        "actions": ["heat"],
        "observations": ["T", "T_wall", "T_out", "sun", "T_set", "price"],
    },
    "reward": {
        "energy": "-price * heat / 1000 * dt_h",
        "cold": "-0.5 * max(T_set - T, 0) * dt_h",
    },
}


class Goal(NamedTuple):
    """A task, and the reward that is asked for; None for that of its tuned controller."""

    task: str
    target: float | None
    minutes: float


GOALS = (
    Goal("fmugym/CartPole-v0", 475, 0.5),
    Goal("fmugym/ModelicaCartPole-v0", 195, 0.5),
    Goal("fmugym/CloudPendulum-v0", -95, 0.5),
    Goal("fmugym/Pendulum-v0", -200, 0.5),
    Goal("fmugym/House-v0", -260, 1.0),
    Goal("drive.toml", None, 1.0),
    Goal("room.toml", None, 1.0),
)
HEADER = [
    *("task", "minutes", "wanted", "reached, median", "worst of five", "reached by"),
    *("baseline", "agent, most often"),
]
QUICK = ("--rounds", "9", "--episodes", "1")


def tables(effort: Effort) -> list[Table]:
    """Measure."""
    table = Table("Rewards in test episodes, by `fmugym train TASK` from five seeds", HEADER)
    with tempfile.TemporaryDirectory() as folder:
        write_plants(Path(folder))
        for goal in GOALS[:1] if effort.quick else GOALS:
            seeds = SEEDS[:1] if effort.quick else SEEDS
            runs = [train(goal, seed, Path(folder), effort.quick) for seed in seeds]
            table.rows.append(_row(goal, runs))
            table.data += [{"task": goal.task, **run} for run in runs]
    return [table]


def write_plants(folder: Path) -> None:
    """Write the tasks of the drive and the room, and build their FMUs."""
    import fmugym

    for name, task in (("drive", DRIVE), ("room", ROOM)):
        script = HERE / f"plant_{name}.py"
        build = [sys.executable, "-m", "pythonfmu", "build", "-f", str(script), "-d", str(folder)]
        build.append("--handle-state")  # plans begin in saved states
        subprocess.run(build, check=True, capture_output=True)
        fmugym.Task.from_dict(task, folder).write(folder / f"{name}.toml")


def train(goal: Goal, seed: int, folder: Path, quick: bool) -> dict[str, Any]:
    """Train once; the facts of the agent, and the seconds with the test and the start."""
    begin = time.perf_counter()
    output = folder / f"{goal.task.replace('/', '-')}-{seed}"
    more = QUICK if quick else ("--minutes", str(goal.minutes))
    command = ["train", goal.task, "--output", str(output), "--seed", str(seed), "--json", *more]
    done = subprocess.run(
        [sys.executable, "-m", "fmugym", *command],
        check=True,
        capture_output=True,
        text=True,
        cwd=folder,
    )
    facts: dict[str, Any] = json.loads(done.stdout)
    return {"seed": seed, "folder": str(output), "seconds": time.perf_counter() - begin, **facts}


def _row(goal: Goal, runs: list[dict[str, Any]]) -> list[str]:
    reached = [_total(run["test"], run["agent"]) for run in runs]
    baselines = [_total(run["test"], run["baseline"]) for run in runs]
    wanted = [base if goal.target is None else goal.target for base in baselines]
    count = sum(one >= least for one, least in zip(reached, wanted, strict=True))
    return [
        f"`{goal.task}`" if "/" in goal.task else f"the {Path(goal.task).stem}",
        f"{goal.minutes:g}",
        f"{goal.target or 'its baseline'}",
        f"{statistics.median(reached):.4g}",
        f"{min(reached):.4g}",
        f"{count} of {len(runs)}",
        f"{statistics.median(baselines):.4g}",
        statistics.mode(run["agent"] for run in runs),
    ]


def _total(test: Mapping[str, Any], name: str) -> float:
    total: float = test[name]["total_reward"]
    return total
