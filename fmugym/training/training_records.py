"""Records of a training beside the agent: recordings, the learning curve, a report."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from fmugym.checks import check_option
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.extras import imported
from fmugym.files import replaced
from fmugym.series import RecordSeries, RecordVectorSeries
from fmugym.series.plots import COLOURS, drawing_style
from fmugym.vector import FMUVectorEnv

__all__ = [
    "CURVE",
    "EVALUATIONS",
    "RECORDS",
    "REPORT",
    "TrainingRecords",
    "append_row",
    "curve_of",
    "draw_curve",
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
