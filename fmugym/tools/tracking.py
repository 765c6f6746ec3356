"""Trainings in the logs of others: Weights & Biases, MLflow."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from fmugym.series.store import imported

__all__ = ["TRACKERS", "Tracker", "open_tracker"]


class Tracker:
    """Takes the numbers of a training.

    Args:
        log: Takes numbers by name, and the step.
        end: Is called at the end.
    """

    def __init__(
        self, log: Callable[[Mapping[str, float], int], None], end: Callable[[], None]
    ) -> None:
        self._log, self._end = log, end

    def log(self, numbers: Mapping[str, Any], step: int) -> None:
        """Log what is a number."""
        kept = {n: float(v) for n, v in numbers.items() if isinstance(v, int | float)}
        self._log(kept, step)

    def write(
        self, key_values: Mapping[str, Any], key_excluded: Mapping[str, Any], step: int = 0
    ) -> None:
        """Log what Stable-Baselines3 logs; its loggers call this."""
        self.log({n: getattr(v, "item", lambda v=v: v)() for n, v in key_values.items()}, step)

    def close(self) -> None:
        """End the log; more than one call is fine."""
        end, self._end = self._end, lambda: None
        end()


def open_tracker(kind: str, facts: Mapping[str, Any], folder: Path) -> Tracker:
    """Begin a run. Where it is logged to, environment variables of the library tell.

    Args:
        kind: A key of ``TRACKERS``.
        facts: What the run is: task, algorithm, arguments.
        folder: That of the training; its name is that of the run.

    Raises:
        ConfigError: If the library is missing.
    """
    return TRACKERS[kind](facts, folder)


def _of_wandb(facts: Mapping[str, Any], folder: Path) -> Tracker:
    wandb: Any = imported("wandb", "wandb")
    run = wandb.init(project="fmugym", name=folder.name, config=dict(facts), dir=str(folder))
    return Tracker(lambda numbers, step: run.log(dict(numbers), step=step), run.finish)


def _of_mlflow(facts: Mapping[str, Any], folder: Path) -> Tracker:
    mlflow: Any = imported("mlflow", "mlflow")
    mlflow.start_run(run_name=folder.name)
    mlflow.log_params({name: str(value) for name, value in facts.items()})

    def log(numbers: Mapping[str, float], step: int) -> None:
        mlflow.log_metrics({n.replace("/", "."): v for n, v in numbers.items()}, step=step)

    return Tracker(log, mlflow.end_run)


TRACKERS: Final[Mapping[str, Callable[[Mapping[str, Any], Path], Tracker]]] = {
    "mlflow": _of_mlflow,
    "wandb": _of_wandb,
}
"""The logs by name."""
