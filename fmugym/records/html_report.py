"""A report of episodes as one page of HTML, which needs no other file and no network."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from html import escape
from statistics import fmean
from typing import Final

from fmugym.checks import check_path
from fmugym.environment.episode import Quantity
from fmugym.records.episode_statistics import (
    FIGURES,
    EpisodeSummary,
    confidence,
    courses,
    summaries,
)
from fmugym.records.plots import as_svg
from fmugym.records.time_series import TimeSeries

__all__ = ["write_report"]

_STYLE: Final = """
:root { --ink: #1d2329; --soft: #5b6670; --line: #dde2e6; --wash: #f5f7f9; --accent: #0072b2;
  --bad: #b00020; --good: #1b7f4d; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 28px 24px 60px; max-width: 1080px; color: var(--ink);
  background: #fff; font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 26px; line-height: 1.25; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 36px 0 10px; padding-top: 14px; border-top: 1px solid var(--line); }
h3 { font-size: 15px; margin: 26px 0 4px; }
p { margin: 0 0 10px; max-width: 70ch; overflow-wrap: anywhere; }
.soft, figcaption, dt { color: var(--soft); }
dl { display: flex; flex-wrap: wrap; gap: 6px 28px; margin: 14px 0 0; font-size: 13px; }
dl div { min-width: 0; }
dt { font-size: 12px; }
dd { margin: 0; overflow-wrap: anywhere; }
.wide { overflow-x: auto; border: 1px solid var(--line); border-radius: 6px; margin: 0 0 12px; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px;
  font-variant-numeric: tabular-nums; }
th, td { padding: 6px 12px; text-align: right; white-space: nowrap; }
th { background: var(--wash); font-weight: 600; color: var(--soft); }
tr + tr td { border-top: 1px solid var(--line); }
th.text, td.text { text-align: left; }
td.first { font-weight: 600; white-space: normal; min-width: 16ch; }
td.bad { color: var(--bad); font-weight: 600; }
td.best { color: var(--good); font-weight: 600; }
figure { margin: 6px 0 0; overflow-x: auto; }
figure svg { display: block; width: 100%; min-width: 560px; height: auto; }
figcaption { font-size: 12.5px; }
details { margin: 8px 0; }
summary { cursor: pointer; color: var(--accent); }
pre { background: var(--wash); border: 1px solid var(--line); border-radius: 6px; padding: 12px;
  overflow-x: auto; font: 12.5px/1.5 ui-monospace, "DejaVu Sans Mono", Consolas, monospace; }
@media print { body { max-width: none; padding: 0; } figure { break-inside: avoid; } }
"""

_PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
{body}
</body>
</html>
"""

_MOST_PICTURES: Final = 6
"""The episodes of each run that are drawn."""

_CAPTION: Final = "Dashed lines: set points (black) and limits (red)."

_IDS: Final = re.compile(r'(\bid="|url\(#|href="#)')


def write_report(
    path: str | os.PathLike[str],
    runs: Mapping[str, TimeSeries],
    *,
    title: str,
    description: str = "",
    facts: Mapping[str, str] | None = None,
    text: str = "",
    charts: Mapping[str, str] | None = None,
) -> None:
    """Write a report of episodes.

    Args:
        path: A new file.
        runs: Recorded episodes, by the name of the controller or agent. One is enough.
        title: The heading.
        description: Description of the task.
        facts: More to know, by name: the FMU, versions.
        text: The task, as its file has it.
        charts: More pictures, by their headings: SVG elements, as ``Figure.savefig`` of Matplotlib
            writes them.

    Raises:
        ConfigError: If Matplotlib is missing, or nothing was recorded.
        FileExistsError: If the file exists.
    """
    file = check_path("the path of a report", path)
    body = "\n".join(_body(runs, title, description, facts or {}, text, charts or {}))
    page = _PAGE.format(title=escape(title), style=_STYLE, body=body)
    with file.open("x", encoding="utf-8", newline="\n") as stream:
        stream.write(page)


def _body(
    runs: Mapping[str, TimeSeries],
    title: str,
    description: str,
    facts: Mapping[str, str],
    text: str,
    charts: Mapping[str, str],
) -> Iterator[str]:
    found = {name: summaries(series) for name, series in runs.items()}
    yield f"<header><h1>{escape(title)}</h1>"
    yield f"<p>{escape(description)}</p>" if description else ""
    pairs = "".join(
        f"<div><dt>{escape(n)}</dt><dd>{escape(v)}</dd></div>" for n, v in facts.items()
    )
    yield f"<dl>{pairs}</dl></header>"
    yield "<h2>Results</h2>"
    yield from _results(found, runs)
    for number, (heading, chart) in enumerate(charts.items()):
        svg = _inline(chart[max(0, chart.find("<svg")) :], f"c{number}")
        yield f"<h2>{escape(heading)}</h2><figure>{svg}</figure>"
    for number, (name, series) in enumerate(runs.items()):
        yield f"<h2>{escape(name)}</h2>"
        yield from _episodes(series, f"r{number}")
    if text:
        yield f"<h2>Task</h2><pre>{escape(text)}</pre>"


def _results(
    found: Mapping[str, Sequence[EpisodeSummary]], runs: Mapping[str, TimeSeries]
) -> Iterator[str]:
    """Tables of the means, and of all episodes if a run has several."""
    rows = [(name, one) for name, episodes in found.items() for one in episodes]
    limits = {k: limit for series in runs.values() for k, limit in series.cost_limits.items()}
    figures = _Figures([one for _, one in rows], limits)
    if any(len(episodes) > 1 for episodes in found.values()):
        yield "<h3>Means over the episodes of each run</h3>"
        yield _means(found, figures)
        if len(found) > 1:
            first = escape(next(iter(found)))
            yield f'<p class="soft">Gain: the reward beside that of {first}, by episodes.</p>'
        yield "<h3>Each episode</h3>"
    several = len({one.environment for _, one in rows}) > 1
    header = ["", *(["environment"] if several else []), "episode", *figures.header]
    cells = [
        [
            _text(name, "first"),
            *([_cell(str(one.environment))] if several else []),
            _cell(str(one.episode)),
            *figures.cells(one),
            _cell(str(one.steps)),
            _cell(_duration(one.seconds)),
            _text(one.end),
        ]
        for name, one in rows
    ]
    yield _table([*header, "steps", "simulated", "end"], cells)
    if limits:
        yield '<p class="soft">Costs above their limit are red.</p>'


class _Figures:
    """The columns that episodes and means over them have: the reward, its terms, costs, KPIs."""

    def __init__(self, episodes: Sequence[EpisodeSummary], limits: Mapping[str, float]) -> None:
        columns = dict.fromkeys(column for one in episodes for column in one.figures)
        self._limits: dict[Quantity, float] = {}
        self.header = ["reward"]
        for column in sorted(columns, key=lambda column: FIGURES.index(column.kind)):
            name = column.name.partition(".")[2]
            limit = limits.get(name, math.inf) if column.kind == "cost term" else math.inf
            self._limits[column] = limit
            self.header.append(f"{name} (at most {limit:g})" if limit < math.inf else name)

    def cells(self, one: EpisodeSummary, kind: str = "") -> Iterator[str]:
        """Cells of a row, of the kind of its reward."""
        yield _cell(_number(one.reward), kind)
        for column, limit in self._limits.items():
            value = one.figures.get(column, math.nan)
            yield _cell(_number(value), "bad" if value > limit else "")


def _means(found: Mapping[str, Sequence[EpisodeSummary]], figures: _Figures) -> str:
    means = {name: _mean(episodes) for name, episodes in found.items() if episodes}
    best = max(one.reward for one in means.values()) if len(means) > 1 else None
    gain = ["gain", "± (95 %)"] if len(means) > 1 else []
    reward, *others = figures.header
    header = ["", "episodes", reward, "± (95 %)", *gain, *others]
    rows = []
    for name, one in means.items():
        cell, *more = figures.cells(one, "best" if one.reward == best else "")
        half = _number(confidence([episode.reward for episode in found[name]]))
        gains = _gains(found[name], next(iter(found.values())))
        both = [fmean(gains) if gains else None, confidence(gains)][: len(gain)]
        told = cell, _cell(half), *(_cell(_number(number)) for number in both)
        rows.append([_text(name, "first"), _cell(str(len(found[name]))), *told, *more])
    return _table(header, rows)


def _gains(run: Sequence[EpisodeSummary], first: Sequence[EpisodeSummary]) -> list[float]:
    """Rewards of a run's episodes, less the rewards of the same ones of the first run."""
    rewards = {(one.environment, one.episode): one.reward for one in first if run is not first}
    pairs = [(one.reward, rewards.get((one.environment, one.episode))) for one in run]
    return [reward - other for reward, other in pairs if other is not None]


def _mean(episodes: Sequence[EpisodeSummary]) -> EpisodeSummary:
    """Means of rewards, costs and KPIs over the episodes that have them."""
    return replace(
        episodes[0],
        reward=fmean(one.reward for one in episodes),
        figures={
            column: fmean(one.figures[column] for one in episodes) for column in episodes[0].figures
        },
    )


def _episodes(series: TimeSeries, prefix: str) -> Iterator[str]:
    episodes = series.episodes()
    for number, (key, one) in enumerate(list(episodes.items())[:_MOST_PICTURES]):
        where = f"Environment {key[0]}, episode {key[1]}" if key[0] else f"Episode {key[1]}"
        yield f"<h3>{where}</h3>" if len(episodes) > 1 else ""
        picture = _inline(as_svg(one), f"{prefix}-{number}")
        yield f"<figure>{picture}<figcaption>{_CAPTION}</figcaption></figure>"
        rows = [
            [_text(column.name, "first"), _text(column.unit), *map(_cell, map(_number, numbers))]
            for column, numbers in courses(one)
        ]
        header = ["variable", "unit", "least", "mean", "most", "last", "mean distance to set point"]
        opened = "" if len(episodes) > 1 else " open"
        table = _table(header, rows)
        yield f"<details{opened}><summary>Variables in numbers</summary>{table}</details>"
    if len(episodes) > _MOST_PICTURES:
        yield f'<p class="soft">{len(episodes) - _MOST_PICTURES} more episodes are not drawn.</p>'


def _inline(svg: str, prefix: str) -> str:
    """Make the names inside of a picture its own: several are on one page."""
    return _IDS.sub(rf"\g<1>{prefix}-", svg)


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    texts = {i for i in range(len(header)) if rows and 'class="text' in rows[0][i]}
    head = "".join(
        f'<th class="text">{escape(name)}</th>' if i in texts else f"<th>{escape(name)}</th>"
        for i, name in enumerate(header)
    )
    body = "".join(f"<tr>{''.join(row)}</tr>\n" for row in rows)
    return f'<div class="wide"><table><tr>{head}</tr>\n{body}</table></div>'


def _text(text: str, kind: str = "") -> str:
    return f'<td class="text {kind}">{escape(text)}</td>'


def _cell(text: str, kind: str = "") -> str:
    return f'<td class="{kind}">{text}</td>' if kind else f"<td>{text}</td>"


def _number(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.4g}".replace("-", "\u2212")


def _duration(seconds: float) -> str:
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.4g} {unit}"
    return f"{seconds:.4g} s"
