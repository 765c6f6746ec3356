"""Records of a training beside the agent: recordings, the learning curve, a report.

Trackers report to logs of Weights & Biases and MLflow.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.checks import check_option
from fmugym.environment.env import FMUEnv
from fmugym.environment.vector import FMUVectorEnv
from fmugym.errors import ConfigError
from fmugym.extras import imported
from fmugym.files import replaced
from fmugym.records import RecordSeries, RecordVectorSeries
from fmugym.records.plots import COLOURS, drawing_style

__all__ = [
    "CURVE",
    "EVALUATIONS",
    "RECORDS",
    "REPORT",
    "TRACKERS",
    "Tracker",
    "TrainingRecords",
    "append_row",
    "curve_of",
    "draw_curve",
    "tracker_for",
]

EVALUATIONS: Final = "evaluations.csv"
CURVE: Final = "evaluations.png"
RECORDS: Final = "records"
REPORT: Final = "report.html"
_FORMATS: Final = ("csv", "parquet")


@dataclass(frozen=True)
class TrainingRecords:
    """Settings of the records of a training.

    Attributes:
        variables: Globs, as of ``RecordSeries``.
        environments: The numbers of the environments of the training that are recorded.
        every: Seconds from one row to the next; None for each step.
        format: ``"csv"`` or ``"parquet"``.

    Raises:
        ConfigError: If there is no such format, or its library is missing.
    """

    variables: tuple[str, ...]
    environments: tuple[int, ...] = (0,)
    every: float | None = None
    format: str = "csv"

    def __post_init__(self) -> None:
        check_option("format of recordings", self.format, _FORMATS)
        if self.format == "parquet":
            imported("pyarrow", "parquet")

    @classmethod
    def of(cls, facts: Any) -> TrainingRecords | None:
        """Records of a resumed training, from its facts; None if it had none.

        Raises:
            ConfigError: If the facts are damaged.
        """
        if facts is None:
            return None
        try:
            lists = {name: tuple(facts[name]) for name in ("variables", "environments")}
            return cls(**{**facts, **lists})
        except (KeyError, TypeError) as error:
            raise ConfigError(f"the facts of the recording are damaged: {error}") from None

    def facts(self) -> dict[str, Any]:
        """The facts from which ``of`` makes the same object again."""
        return asdict(self)

    def of_training(self, folder: Path, begin: int) -> Callable[[FMUVectorEnv], Any]:
        """Make the wrapper of the training's environments.

        Args:
            folder: Folder of the training. The file is made in the first step.
            begin: The steps that were done before.
        """
        name = f"training_from_{begin}" if begin else "training"
        path = folder / RECORDS / f"{name}.{self.format}"

        def wrap(envs: FMUVectorEnv) -> RecordVectorSeries:
            path.unlink(missing_ok=True)  # of a training that was interrupted and is resumed again
            arguments: Any = {"every": self.every, "path": path, "most_rows": 1}
            return RecordVectorSeries(
                envs, self.variables, environments=self.environments, **arguments
            )

        return wrap

    def of_evaluation(self, folder: Path, steps: int, name: str) -> Callable[[FMUEnv], Any]:
        """Make the wrapper of an evaluation's environment; its file is replaced."""
        safe = re.sub(r"[^\w.-]+", "_", name)
        path = folder / RECORDS / f"evaluation-{steps}-{safe}.{self.format}"

        def wrap(env: FMUEnv) -> RecordSeries:
            path.unlink(missing_ok=True)
            return RecordSeries(env, self.variables, every=self.every, path=path, most_rows=1)

        return wrap


def append_row(
    folder: Path, names: Sequence[str], row: Sequence[Any], name: str = EVALUATIONS
) -> None:
    """Add a row to a table of a training, which is made if there is none.

    Args:
        folder: Folder of the training.
        names: Names of the columns; in ``evaluations.csv`` steps and mean reward are the first.
        row: The values.
        name: Name of the file.
    """
    path = folder / name
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    with replaced(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        file.write(before)
        writer = csv.writer(file, lineterminator="\n")
        if not before:
            writer.writerow(names)
        writer.writerow(row)


def curve_of(folder: Path) -> Mapping[str, list[float]]:
    """Columns of ``evaluations.csv``: steps, mean reward, and the mean of each scenario."""
    with (folder / EVALUATIONS).open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


def _limits(curves: Iterable[Sequence[float]]) -> tuple[float, float]:
    """Limits of the axis of rewards, which the first quarter of a training may leave."""
    shown = [value for curve in curves for value in curve[len(curve) // 4 :]]
    margin = 0.08 * (max(shown) - min(shown)) or 1.0
    return min(shown) - margin, max(shown) + margin


def draw_curve(columns: Mapping[str, list[float]], title: str) -> Any:
    """Draw the rewards of all evaluations of a training.

    Args:
        columns: As ``curve_of`` returns them.
        title: A line of text above.

    Returns:
        The figure of Matplotlib.

    Raises:
        ConfigError: If Matplotlib is missing.
    """
    figures: Any = imported("matplotlib.figure", "plot")
    steps, mean, *_ = columns.values()
    each = {name: values for name, values in list(columns.items())[2:] if values != mean}
    with drawing_style():
        figure = figures.Figure(figsize=(9, 3.4), layout="constrained")
        axes = figure.subplots()
        for colour, (name, values) in zip(COLOURS[1:] * len(each), each.items(), strict=False):
            axes.plot(steps, values, "o-", markersize=3, color=colour, linewidth=1, label=name)
        axes.plot(steps, mean, "o-", markersize=4, color=COLOURS[0], linewidth=2, label="mean")
        best = max(range(len(mean)), key=mean.__getitem__)
        axes.plot(steps[best], mean[best], "*", markersize=13, color=COLOURS[0], label="best agent")
        axes.set(xlabel="steps of training", ylabel="reward in evaluation")
        axes.set_ylim(*_limits([mean, *each.values()]))
        axes.legend(frameon=False, loc="lower right")
        figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
    return figure


class Tracker(NamedTuple):
    """Takes the numbers of a training.

    Attributes:
        take: Takes numbers by name, and the step.
        close: Is called at the end.
    """

    take: Callable[[Mapping[str, float], int], None]
    close: Callable[[], None]

    def log(self, numbers: Mapping[str, Any], step: int) -> None:
        """Log the numbers among some values, of Python or of numpy."""
        kept = {n: float(v) for n, v in numbers.items() if isinstance(v, int | float | np.number)}
        self.take(kept, step)


def tracker_for(kind: str, facts: Mapping[str, Any], folder: Path) -> Callable[[], Tracker]:
    """Make a function that begins a run; environment variables of the library tell where.

    Args:
        kind: A key of ``TRACKERS``.
        facts: Facts about the run: task, algorithm, arguments.
        folder: Folder of the training, which is there when the run begins; its name is the run's.

    Raises:
        ConfigError: If the library is missing.
    """
    library = imported(kind, kind)
    return partial(TRACKERS[kind], library, facts, folder)


def _of_wandb(wandb: Any, facts: Mapping[str, Any], folder: Path) -> Tracker:
    run = wandb.init(project="fmugym", name=folder.name, config=dict(facts), dir=str(folder))
    return Tracker(lambda numbers, step: run.log(dict(numbers), step=step), run.finish)


def _of_mlflow(mlflow: Any, facts: Mapping[str, Any], folder: Path) -> Tracker:
    mlflow.start_run(run_name=folder.name)
    mlflow.log_params({name: str(value) for name, value in facts.items()})

    def log(numbers: Mapping[str, float], step: int) -> None:
        mlflow.log_metrics({n.replace("/", "."): v for n, v in numbers.items()}, step=step)

    return Tracker(log, mlflow.end_run)


TRACKERS: Final[Mapping[str, Callable[[Any, Mapping[str, Any], Path], Tracker]]] = {
    "mlflow": _of_mlflow,
    "wandb": _of_wandb,
}
"""Trackers by name, which is also the name of the module and the extra."""
