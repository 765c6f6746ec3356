"""Trackers: logs of Weights & Biases and MLflow, to which trainings report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.extras import imported

__all__ = ["TRACKERS", "Tracker", "tracker_for"]


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
