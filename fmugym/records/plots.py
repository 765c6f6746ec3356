"""Pictures of an episode: a panel for each unit, with limits, set points, rewards and costs."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from io import StringIO
from itertools import pairwise
from typing import Any, Final

import numpy as np

from fmugym.checks import check_path
from fmugym.environment.episode import Quantity
from fmugym.errors import ConfigError
from fmugym.extras import imported
from fmugym.files import replaced
from fmugym.records.time_series import TimeSeries

__all__ = ["COLOURS", "as_svg", "drawing_style", "plot", "svg_of"]

COLOURS: Final = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#7f7f7f",
    "#882255",
)
"""Colours that people with colour blindness can tell apart: Okabe and Ito, 2008, and two more."""

_BAND: Final = "#0072b2"
_LIMIT: Final = "#b00020"
_UNITS_OF_TIME: Final = (
    (3 * 86400, 86400, "days"),
    (3 * 3600, 3600, "hours"),
    (600, 60, "minutes"),
)
_MOST_LINES: Final = 8
_MOST_POINTS: Final = 4_000

_PATH: Final = re.compile(r' d="[^"]*"')
_DIGITS: Final = re.compile(r"(\.\d\d)\d+")
"""Digits of points in paths that no one can see."""

_SUMMED: Final = {"rewards": ("reward term",), "costs": ("cost term",)}

_METADATA: Final = ("Date", "Creator", "Format", "Type")

_STYLE: Final[dict[str, Any]] = {
    "font.size": 9,
    "font.family": "sans-serif",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a8a8a",
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.8,
    "lines.linewidth": 1.4,
    "svg.fonttype": "none",
    "svg.hashsalt": "fmugym",
}


@dataclass(frozen=True)
class _Panel:
    """A part of the picture with an axis of its own.

    Attributes:
        label: Label of the axis.
        columns: The lines.
        setpoints: Set points of these.
        summed: Whether the lines are sums since the beginning of the episode.
    """

    label: str
    columns: tuple[Quantity, ...]
    setpoints: tuple[Quantity, ...] = ()
    summed: bool = False

    @property
    def height(self) -> float:
        """Height as a multiple of the height of a panel with one line."""
        return 1.0 if self.summed or len(self.columns) == 1 else 1.4


def plot(series: TimeSeries, path: str | os.PathLike[str] | None = None, title: str = "") -> Any:
    """Draw an episode.

    Variables with set points come first, each in a panel of its own; two set points are the edges
    of a band. All others share a panel with those of the same unit: outputs, data, actions. Below
    are the terms of the reward and the costs, summed up over the episode. Dashed red lines are
    limits.

    Args:
        series: The rows of one episode, see ``TimeSeries.episodes``.
        path: A file to write, such as ``run.png`` or ``run.svg``; None for no file.
        title: A line of text above.

    Returns:
        The figure of Matplotlib.

    Raises:
        ConfigError: If Matplotlib is missing, the rows are of several episodes, or the format of
            the file is unknown.
    """
    if len(series.episodes()) != 1:
        raise ConfigError(f"one episode can be drawn, got {len(series.episodes())}")
    figure = _figure(series, title)
    if path is not None:
        file = check_path("the path of a picture", path)
        try:
            with replaced(file) as part:
                figure.savefig(part, dpi=150)
        except ValueError as error:  # of Matplotlib, for a format that it does not know
            raise ConfigError(f"no picture can be written: {error}") from None
    return figure


def as_svg(series: TimeSeries) -> str:
    """Draw an episode as the text of an SVG element, whose letters are text."""
    return svg_of(_figure(series, ""))


def drawing_style() -> AbstractContextManager[None]:
    """The style of all pictures, as a context.

    Raises:
        ConfigError: If Matplotlib is missing.
    """
    context: AbstractContextManager[None] = imported("matplotlib", "plot").rc_context(_STYLE)
    return context


def svg_of(figure: Any) -> str:
    """A figure of Matplotlib as the text of an SVG element, whose letters are text."""
    text = StringIO()
    with drawing_style():
        figure.savefig(text, format="svg", metadata=dict.fromkeys(_METADATA))
    svg = text.getvalue()
    return _PATH.sub(lambda path: _DIGITS.sub(r"\1", path[0]), svg[svg.index("<svg") :])


def _figure(series: TimeSeries, title: str) -> Any:
    figures: Any = imported("fmugym.rendering.figures", "plot")
    panels = _panels(series)
    with drawing_style():
        heights = [panel.height for panel in panels]
        figure = figures.Figure(figsize=(9, 0.7 + 1.4 * sum(heights)), layout="constrained")
        ratios = {"height_ratios": heights}
        axes = figure.subplots(len(panels), sharex=True, squeeze=False, gridspec_kw=ratios)[:, 0]
        times, unit = _times(series)
        for axis, panel in zip(axes, panels, strict=True):
            _draw(axis, panel, series, times)
        axes[-1].set_xlabel(f"time in {unit}")
        axes[0].set_xlim(times[0], times[-1] if times[-1] > times[0] else times[0] + 1)
        if title:
            figure.suptitle(_plain(title), x=0.01, ha="left", fontsize=10, fontweight="bold")
        figure.align_ylabels()
    return figure


def _times(series: TimeSeries) -> tuple[Any, str]:
    """The times since the beginning of the episode, and their unit."""
    times = series["time"] - series["time"][0]
    for least, size, unit in _UNITS_OF_TIME:
        if times[-1] >= least:
            return times / size, unit
    return times, "seconds"


def _panels(series: TimeSeries) -> list[_Panel]:
    """Group the columns that can share an axis."""
    setpoints = series.of_kind("setpoint")
    seen = [*series.of_kind("output", "memory", "expression", "observation")]
    targets = {column.name for column in seen}
    free = [one for one in setpoints if one.of not in targets]
    guided = {one.of for one in setpoints}
    panels = [_panel([c], setpoints) for c in seen if c.name in guided]
    panels += _by_unit([c for c in seen if c.name not in guided])
    panels += _by_unit([*free, *series.of_kind("data")])
    panels += _by_unit(series.of_kind("action"))
    for label, kinds in _SUMMED.items():
        columns = series.of_kind(*kinds) or series.of_kind(label.removesuffix("s"))
        panels += [_Panel(f"sum of {label}", tuple(columns), summed=True)] if columns else []
    return panels


def _by_unit(columns: Sequence[Quantity]) -> list[_Panel]:
    """A panel for each unit; a column without a unit has a panel of its own."""
    groups: dict[str, list[Quantity]] = {}
    for column in columns:
        groups.setdefault(column.unit or f"\0{column.name}", []).append(column)
    return [
        _panel(group[begin : begin + _MOST_LINES])
        for group in groups.values()
        for begin in range(0, len(group), _MOST_LINES)
    ]


def _panel(group: Sequence[Quantity], setpoints: Sequence[Quantity] = ()) -> _Panel:
    """A panel for one column and its set points, or for several of one unit."""
    one, *others = group
    label = f"{one.name} in {one.unit}" if one.unit else one.name
    own = tuple(setpoint for setpoint in setpoints if setpoint.of == one.name)
    return _Panel(one.unit if others else label, tuple(group), own)


def _draw(axis: Any, panel: _Panel, series: TimeSeries, times: Any) -> None:
    for colour, column in zip(COLOURS, panel.columns, strict=False):
        values, label = series[column.name], column.name
        if panel.summed:
            values, label = np.nancumsum(values), label.rpartition(".")[2]
        style = {"color": colour, "drawstyle": _drawstyle(column)}
        axis.plot(*_thinned(times, values), label=_plain(label), **style)
    for setpoint in panel.setpoints:
        axis.plot(
            times,
            series[setpoint.name],
            color="#333333",
            linestyle="--",
            linewidth=1.0,
            label=_plain(setpoint.name),
            drawstyle=_drawstyle(setpoint),
        )
    _draw_band(axis, panel, series, times)
    _draw_limits(axis, panel, series)
    axis.set_ylabel(_plain(panel.label))
    if len(axis.get_legend_handles_labels()[1]) > 1 or panel.summed:
        _draw_legend(axis)
    axis.margins(y=0.08)


def _draw_legend(axis: Any) -> None:
    place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.0}
    axis.legend(**place, ncols=_MOST_LINES, frameon=False, handlelength=1.6)


def _thinned(times: Any, values: Any) -> tuple[Any, Any]:
    """Leave out points that a picture cannot show: of many near each other, two extremes stay."""
    if len(times) <= _MOST_POINTS:
        return times, values
    edges = np.linspace(0, len(times), _MOST_POINTS // 2 + 1).astype(int)
    low, high = np.nan_to_num(values, nan=np.inf), np.nan_to_num(values, nan=-np.inf)
    found = [{a + np.argmin(low[a:b]), a + np.argmax(high[a:b])} for a, b in pairwise(edges)]
    kept = np.unique([0, len(times) - 1, *(index for pair in found for index in pair)])
    return times[kept], values[kept]


def _drawstyle(column: Quantity) -> str:
    """Actions hold since the step before, schedules until the next value."""
    if column.kind in ("action", "input"):
        return "steps-pre"
    return "steps-post" if column.holds else "default"


def _draw_band(axis: Any, panel: _Panel, series: TimeSeries, times: Any) -> None:
    """Fill the area between two set points of one variable."""
    for column in panel.columns:
        own = [one for one in panel.setpoints if one.of == column.name]
        if len(own) == 2:
            edges = [series[one.name] for one in own]
            step = "post" if any(one.holds for one in own) else None
            axis.fill_between(times, *edges, color=_BAND, alpha=0.1, linewidth=0, step=step)


def _draw_limits(axis: Any, panel: _Panel, series: TimeSeries) -> None:
    """Draw the limits that the values come near."""
    low, high = axis.get_ylim()
    for limit in _limits(panel, series):
        if low - (high - low) / 2 <= limit <= high + (high - low) / 2:
            axis.axhline(limit, color=_LIMIT, linestyle=(0, (4, 3)), linewidth=0.9)


def _limits(panel: _Panel, series: TimeSeries) -> list[float]:
    if panel.summed:
        names = {column.name.rpartition(".")[2] for column in panel.columns}
        return [limit for name, limit in series.cost_limits.items() if name in names]
    bounded = [c for c in panel.columns if c.kind in ("action", "output", "memory", "expression")]
    limits = {limit for column in bounded for limit in (column.low, column.high)}
    return sorted(limit for limit in limits if math.isfinite(limit))


def _plain(text: str) -> str:
    """A text in which Matplotlib sees no formula, and no name that it hides."""
    escaped = text.replace("$", r"\$")
    return f" {escaped}" if escaped.startswith("_") else escaped
