"""Episodes in numbers: rewards, costs, KPIs, and the course of variables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.series.timeseries import TimeSeries
from fmugym.task.quantity import Quantity

__all__ = ["Course", "EpisodeSummary", "TextCourse", "courses", "summaries", "text_courses"]


@dataclass(frozen=True)
class EpisodeSummary:
    """An episode in numbers.

    Attributes:
        environment, episode: Their numbers.
        steps: How many steps it had.
        seconds: The simulated time.
        reward: The total reward.
        terms: The totals of its terms by name.
        costs: The totals of its parts by name.
        kpis: The KPIs of the task by name.
        end: ``"terminated"``, ``"truncated"``, ``"fault: ..."``, or ``"stopped"`` before the end.
    """

    environment: int
    episode: int
    steps: int
    seconds: float
    reward: float
    terms: Mapping[str, float]
    costs: Mapping[str, float]
    kpis: Mapping[str, float]
    end: str


@dataclass(frozen=True)
class Course:
    """The course of a variable in an episode.

    Attributes:
        quantity: The variable.
        least, mean, most, last: Its values.
        deviation: The mean absolute difference from its set point; None without one set point.
    """

    quantity: Quantity
    least: float
    mean: float
    most: float
    last: float
    deviation: float | None


@dataclass(frozen=True)
class TextCourse:
    """One text of a String in an episode.

    Attributes:
        name: The name of the String.
        text: The text.
        begin: When the String had it first, in seconds since the beginning of the episode.
        share: The part of the rows in which it has it.
    """

    name: str
    text: str
    begin: float
    share: float


def summaries(series: TimeSeries) -> list[EpisodeSummary]:
    """Sum up all episodes."""
    return [_summary(key, one) for key, one in series.episodes().items()]


def _summary(key: tuple[int, int], series: TimeSeries) -> EpisodeSummary:
    times = series["time"]
    return EpisodeSummary(
        *key,
        steps=int(series["step"][-1]),
        seconds=float(times[-1] - times[0]),
        reward=_total(series, "reward"),
        terms=_totals(series, "reward term"),
        costs=_totals(series, "cost term"),
        kpis={one.name.partition(".")[2]: series[one.name][-1] for one in series.of_kind("kpi")},
        end=_end(series),
    )


def _end(series: TimeSeries) -> str:
    for why in series.faults.values():
        return f"fault: {why}"
    ends = [name for name in ("terminated", "truncated") if series[name][-1]]
    return ends[0] if ends else "stopped"


def _total(series: TimeSeries, name: str) -> float:
    return float(series[name].sum())


def _totals(series: TimeSeries, kind: str) -> dict[str, float]:
    columns = series.of_kind(kind)
    return {one.name.partition(".")[2]: _total(series, one.name) for one in columns}


def courses(series: TimeSeries) -> Iterator[Course]:
    """Sum up the course of variables in an episode; those without any value are left out."""
    setpoints = series.of_kind("setpoint")
    for column in series.of_kind("output", "action", "data", "setpoint", "memory", "expression"):
        values = series[column.name]
        known = values[np.isfinite(values)]
        if len(known):
            own = [series[one.name] for one in setpoints if one.of == column.name]
            deviation = float(np.nanmean(np.abs(values - own[0]))) if len(own) == 1 else None
            yield Course(column, *_figures(known), deviation)


def text_courses(series: TimeSeries) -> Iterator[TextCourse]:
    """Sum up the texts of Strings in an episode, in the order in which they come."""
    times = series["time"] - series["time"][0]
    for column in series.of_kind("text"):
        cells = series[column.name]
        for text in dict.fromkeys(cells.tolist()):
            found = cells == text
            begin = float(times[found.argmax()])
            yield TextCourse(column.name, text or "", begin, float(found.mean()))


def _figures(values: Any) -> tuple[float, float, float, float]:
    return float(values.min()), float(values.mean()), float(values.max()), float(values[-1])
