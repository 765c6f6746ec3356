"""A report of episodes as one page of HTML, which needs no other file and no network."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from typing import Final

from fmugym.checks import check_path
from fmugym.series.intervals import confidence
from fmugym.series.plots import as_svg
from fmugym.series.summary import (
    Course,
    EpisodeSummary,
    TextCourse,
    courses,
    summaries,
    text_courses,
)
from fmugym.series.timeseries import TimeSeries

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
    most_pictures: int = 6,
) -> None:
    """Write a report of episodes.

    Args:
        path: A new file.
        runs: What was recorded, by the name of the controller or agent. One is enough.
        title: The heading.
        description: What the task is about.
        facts: More to know, by name: the FMU, versions.
        text: The task, as its file has it.
        charts: More pictures, by their headings: SVG elements, as ``Figure.savefig`` of Matplotlib
            writes them.
        most_pictures: The episodes of each run that are drawn.

    Raises:
        ConfigError: If Matplotlib is missing, or nothing was recorded.
        FileExistsError: If the file exists.
    """
    file = check_path("the path of a report", path)
    body = "\n".join(
        _body(runs, title, description, facts or {}, text, charts or {}, most_pictures)
    )
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
    most: int,
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
        yield from _episodes(series, most, f"r{number}")
    if text:
        yield f"<h2>Task</h2><pre>{escape(text)}</pre>"


def _results(
    found: Mapping[str, Sequence[EpisodeSummary]], runs: Mapping[str, TimeSeries]
) -> Iterator[str]:
    """The table of means, and that of all episodes if there are several of a run."""
    rows = [(name, one) for name, episodes in found.items() for one in episodes]
    limits = {k: limit for series in runs.values() for k, limit in series.cost_limits.items()}
    if any(len(episodes) > 1 for episodes in found.values()):
        yield "<h3>Means over the episodes of each run</h3>"
        yield _means(found, limits)
        yield "<h3>Each episode</h3>"
    yield _table(_header(rows, limits), [_row(name, one, rows, limits) for name, one in rows])
    if limits:
        yield '<p class="soft">Costs above their limit are red.</p>'


def _names(rows: Iterable[tuple[str, EpisodeSummary]], group: str) -> list[str]:
    return list(dict.fromkeys(name for _, one in rows for name in getattr(one, group)))


def _header(rows: Sequence[tuple[str, EpisodeSummary]], limits: Mapping[str, float]) -> list[str]:
    several = _has_many(rows)
    costs = [f"{n} (at most {limits[n]:g})" if n in limits else n for n in _names(rows, "costs")]
    return [
        *("", *(["environment"] if several else []), "episode", "reward"),
        *_names(rows, "terms"),
        *costs,
        *_names(rows, "kpis"),
        *("steps", "simulated", "end"),
    ]


def _has_many(rows: Sequence[tuple[str, EpisodeSummary]]) -> bool:
    return len({one.environment for _, one in rows}) > 1


def _row(
    name: str,
    one: EpisodeSummary,
    rows: Sequence[tuple[str, EpisodeSummary]],
    limits: Mapping[str, float],
) -> list[str]:
    """The cells of an episode."""
    return [
        _text(name, "first"),
        *([_cell(str(one.environment))] if _has_many(rows) else []),
        _cell(str(one.episode)),
        _cell(_number(one.reward)),
        *(_cell(_number(one.terms.get(n))) for n in _names(rows, "terms")),
        *(_cost(one.costs.get(n), limits.get(n)) for n in _names(rows, "costs")),
        *(_cell(_number(one.kpis.get(n))) for n in _names(rows, "kpis")),
        _cell(str(one.steps)),
        _cell(_duration(one.seconds)),
        _text(one.end),
    ]


def _means(found: Mapping[str, Sequence[EpisodeSummary]], limits: Mapping[str, float]) -> str:
    rows = [(name, one) for name, episodes in found.items() for one in episodes]
    terms, costs, kpis = (_names(rows, group) for group in ("terms", "costs", "kpis"))
    best = max(_mean([one.reward for one in episodes]) for episodes in found.values())
    cells = []
    for name, episodes in found.items():
        rewards = [one.reward for one in episodes]
        reward, half = _mean(rewards), confidence(rewards)
        is_best = len(found) > 1 and reward == best
        cells.append(
            [
                _text(name, "first"),
                _cell(str(len(episodes))),
                _cell(_number(reward), "best" if is_best else ""),
                _cell(_number(half)),
                *(_cell(_number(_mean_of(episodes, "terms", n))) for n in terms),
                *(_cost(_mean_of(episodes, "costs", n), limits.get(n)) for n in costs),
                *(_cell(_number(_mean_of(episodes, "kpis", n))) for n in kpis),
            ]
        )
    return _table(["", "episodes", "reward", "± (95 %)", *terms, *costs, *kpis], cells)


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan


def _mean_of(episodes: Sequence[EpisodeSummary], group: str, name: str) -> float:
    dicts = [getattr(one, group) for one in episodes]
    return _mean([values[name] for values in dicts if name in values])


def _episodes(series: TimeSeries, most: int, prefix: str) -> Iterator[str]:
    episodes = series.episodes()
    for number, (key, one) in enumerate(list(episodes.items())[:most]):
        where = f"Environment {key[0]}, episode {key[1]}" if key[0] else f"Episode {key[1]}"
        yield f"<h3>{where}</h3>" if len(episodes) > 1 else ""
        picture = _inline(as_svg(one), f"{prefix}-{number}")
        yield f"<figure>{picture}<figcaption>{_CAPTION}</figcaption></figure>"
        rows = [_course(course) for course in courses(one)]
        header = ["variable", "unit", "least", "mean", "most", "last", "mean distance to set point"]
        opened = "" if len(episodes) > 1 else " open"
        table = _table(header, rows)
        yield f"<details{opened}><summary>Variables in numbers</summary>{table}</details>"
        if texts := list(text_courses(one)):
            table = _table(["String", "text", "first at", "share"], list(map(_texts, texts)))
            yield f"<details{opened}><summary>Strings</summary>{table}</details>"
    if len(episodes) > most:
        yield f'<p class="soft">{len(episodes) - most} more episodes are not drawn.</p>'


def _inline(svg: str, prefix: str) -> str:
    """Make the names inside of a picture its own: several are on one page."""
    return _IDS.sub(rf"\g<1>{prefix}-", svg)


def _course(course: Course) -> list[str]:
    unit = _text(course.quantity.unit)
    numbers = course.least, course.mean, course.most, course.last, course.deviation
    return [_text(course.quantity.name, "first"), unit, *(_cell(_number(n)) for n in numbers)]


def _texts(course: TextCourse) -> list[str]:
    name, text = _text(course.name, "first"), _text(course.text)
    return [name, text, _cell(_duration(course.begin)), _cell(f"{100 * course.share:.3g} %")]


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


def _cost(value: float | None, limit: float | None) -> str:
    is_bad = value is not None and limit is not None and value > limit
    return _cell(_number(value), "bad" if is_bad else "")


def _number(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.4g}".replace("-", "\u2212")


def _duration(seconds: float) -> str:
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.4g} {unit}"
    return f"{seconds:.4g} s"
