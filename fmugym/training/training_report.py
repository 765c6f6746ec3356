"""Results of a training for readers: the learning curve, and a report."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.files import replaced
from fmugym.records import RecordSeries, TimeSeries, write_report
from fmugym.records.evaluation import HELD_OUT_SEED
from fmugym.records.output_files import About
from fmugym.records.players import simulate
from fmugym.records.plots import svg_of
from fmugym.training.agents import AGENT_FILE, agent_player
from fmugym.training.sb3_training import TrainingSettings
from fmugym.training.training_records import CURVE, REPORT, TrainingRecords, curve_of, draw_curve

__all__ = ["write_curve", "write_outcome"]


def write_outcome(settings: TrainingSettings, title: str, tell: Callable[[str], None]) -> None:
    """Draw the curve of a training, and write a report if the training was recorded.

    Files that are there are replaced. Without Matplotlib there are none.

    Args:
        settings: Settings of the training.
        title: Title of the task.
        tell: Gets a line of text if Matplotlib is missing.
    """
    figure = write_curve(settings.folder, f"{title}, trained with {settings.algorithm}", tell)
    if figure is not None and settings.records is not None:
        _write_report(settings, settings.records, title, {"Training": svg_of(figure)})


def write_curve(folder: Path, title: str, tell: Callable[[str], None]) -> Any:
    """Draw the curve of a training.

    Args:
        folder: Folder of the training. A picture that is there is replaced.
        title: A line of text above.
        tell: Gets a line of text if Matplotlib is missing.

    Returns:
        The figure of Matplotlib, or None if there is none.
    """
    try:
        figure = draw_curve(curve_of(folder), title)
    except FileNotFoundError:  # nothing was evaluated, for example after an interruption
        return None
    except ConfigError as error:
        tell(f"there is no picture of the training: {error}")
        return None
    with replaced(folder / CURVE) as part:
        figure.savefig(part, dpi=100)
    return figure


def _write_report(
    settings: TrainingSettings, records: TrainingRecords, title: str, charts: Mapping[str, str]
) -> None:
    """Let the best agent play once more, in the first episode of each evaluation."""
    runs = {
        name: _played(settings, records, make_env) for name, make_env in settings.held_out.items()
    }
    with closing(settings.make_env()) as env:
        about = About.of(env)
    best = json.loads((settings.folder / AGENT_FILE).read_text(encoding="utf-8"))
    facts = {
        "algorithm": settings.algorithm,
        "arguments": ", ".join(f"{k} = {v}" for k, v in (settings.arguments or {}).items())
        or "none",
        "seed": str(settings.seed),
        "environments": str(settings.num_envs),
        "steps of the best agent": str(best["steps"]),
    }
    with replaced(settings.folder / REPORT) as part:
        write_report(
            part,
            runs,
            title=f"{title}: the best agent of a training",
            description=about.description,
            facts={**about.facts, **facts},
            text=about.text,
            charts=charts,
        )


def _played(
    settings: TrainingSettings, records: TrainingRecords, make_env: Callable[[], FMUEnv]
) -> TimeSeries:
    player = agent_player(settings.folder)
    env = player.make_env(make_env)
    with closing(RecordSeries(env, records.variables, every=records.every)) as recorder:
        policy = player.make_policy(env)
        simulate(recorder, policy, HELD_OUT_SEED, settings.most_steps)
        return recorder.series
