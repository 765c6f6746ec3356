"""Episodes in numbers: rewards, costs, KPIs, and the course of variables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.series.timeseries import TimeSeries
from fmugym.task.quantity import Quantity

__all__ = ["FIGURES", "EpisodeSummary", "courses", "summaries"]

FIGURES: Final = ("reward term", "cost term", "kpi")
"""The kinds of columns that tell a number of each episode: its total, or the last KPI."""


@dataclass(frozen=True)
class EpisodeSummary:
    """An episode in numbers.

    Attributes:
        environment, episode: Their numbers.
        steps: Number of its steps.
        seconds: The simulated time.
        reward: The total reward.
        figures: The totals of its terms and of costs, and the KPIs of the task, by their columns.
        end: ``"terminated"``, ``"truncated"``, ``"fault: ..."``, or ``"stopped"`` before the end.
    """

    environment: int
    episode: int
    steps: int
    seconds: float
    reward: float
    figures: Mapping[Quantity, float]
    end: str


def summaries(series: TimeSeries) -> list[EpisodeSummary]:
    """Sum up all episodes."""
    return [_summary(key, one) for key, one in series.episodes().items()]


def _summary(key: tuple[int, int], series: TimeSeries) -> EpisodeSummary:
    times = series["time"]
    return EpisodeSummary(
        *key,
        steps=int(series["step"][-1]),
        seconds=float(times[-1] - times[0]),
        reward=float(series["reward"].sum()),
        figures={one: _figure(series[one.name], one) for one in series.of_kind(*FIGURES)},
        end=_end(series),
    )


def _end(series: TimeSeries) -> str:
    for why in series.faults.values():
        return f"fault: {why}"
    ends = [name for name in ("terminated", "truncated") if series[name][-1]]
    return ends[0] if ends else "stopped"


def _figure(values: Any, column: Quantity) -> float:
    return float(values[-1] if column.kind == "kpi" else values.sum())


def courses(series: TimeSeries) -> Iterator[tuple[Quantity, tuple[float | None, ...]]]:
    """Summarize each variable over an episode, without variables that never have a value.

    Yields:
        The variable; its least, mean, greatest and last value, and the mean absolute difference
        from its set point, which is None without one set point.
    """
    setpoints = series.of_kind("setpoint")
    for column in series.of_kind("output", "action", "data", "setpoint", "memory", "expression"):
        values = series[column.name]
        known = values[np.isfinite(values)]
        if len(known):
            own = [series[one.name] for one in setpoints if one.of == column.name]
            deviation = np.nanmean(np.abs(values - own[0])) if len(own) == 1 else None
            yield column, (known.min(), known.mean(), known.max(), known[-1], deviation)
