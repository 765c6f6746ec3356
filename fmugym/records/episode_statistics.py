"""Episodes in numbers: rewards, costs, KPIs, and the course of variables.

Means over episodes have confidence intervals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import variance
from typing import Any, Final

import numpy as np

from fmugym.environment.episode import Quantity
from fmugym.records.time_series import TimeSeries

__all__ = ["FIGURES", "EpisodeSummary", "confidence", "courses", "summaries"]

_Z: Final = 1.959963984540054
"""The 97.5 % quantile of the normal distribution."""


def confidence(*groups: Sequence[float]) -> float | None:
    """Half the width of the 95 % confidence interval of a mean, by Student's distribution.

    Args:
        groups: The values. Of several groups, it is that of the sum of their means.

    Returns:
        The number; None for fewer than two values.
    """
    freedom = sum(len(values) - 1 for values in groups)
    if freedom < 1:
        return None
    return _student(freedom) * math.sqrt(sum(variance(values) / len(values) for values in groups))


def _student(freedom: int) -> float:
    """The 97.5 % quantile of Student's distribution.

    For one and two degrees of freedom it is a closed form. For more, the error is below 1 %: see
    Peizer and Pratt, "A normal approximation for binomial, F, beta, and other common, related tail
    probabilities", Journal of the American Statistical Association 63 (1968).
    """
    if freedom == 1:
        return math.tan(math.pi * 0.475)
    if freedom == 2:
        return 0.95 * math.sqrt(2.0 / (1.0 - 0.95 * 0.95))
    scaled = _Z / (freedom - 2 / 3 + 0.1 / freedom)
    return math.sqrt(freedom * math.expm1((freedom - 5 / 6) * scaled**2))


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
