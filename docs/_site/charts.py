"""Bars of what is in the tables of the page about speed."""

import re
from pathlib import Path
from typing import Any, Final

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

PAGE: Final = "speed.md"
FACTORS: Final = {"": 1.0, "k": 1e3, "M": 1e6}
RATE: Final = re.compile(r"([\d.]+) ([kM]?) ?")
CHARTS: Final = {"64": "64 environments", "1024": "1,024 environments"}
WIDTH, LABEL, ROW = 860, 270, 30  # of a chart, of its labels and rows, in pixels


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the charts."""
    text = (Path(config.docs_dir) / PAGE).read_text(encoding="utf-8")
    table = next(table for table in _tables(text) if table[0][0] == "environments")
    for column in CHARTS:
        place = table[0].index(column)
        rates = {row[0]: rate for row in table[1:] if (rate := _rate(row[place])) is not None}
        files.append(File.generated(config, f"performance/{column}.svg", content=_chart(rates)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Put the charts above the figures."""
    if page.file.src_uri != PAGE:
        return markdown
    charts = [
        f"## {title}\n\n![{title}: transitions per second](performance/{column}.svg)"
        for column, title in CHARTS.items()
    ]
    title, figures = markdown.split("\n", 1)
    return "\n\n".join([title, *charts, "## All figures", figures])


def _tables(text: str) -> list[list[list[str]]]:
    """The cells of the tables, row by row, without the line below the head."""
    found = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    return [
        [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
        for table in (re.sub(r"^\| ?:-.*\n", "", one, flags=re.MULTILINE) for one in found)
    ]


def _rate(cell: str) -> float | None:
    """Transitions per second: ``1.72 M 12.1x`` is 1,720,000."""
    match = RATE.match(cell)
    return match and float(match[1]) * FACTORS[match[2]]


def _chart(rates: dict[str, float]) -> str:
    """Horizontal bars, the fastest first."""
    largest = max(rates.values())
    rows = [
        _bar(number, name, rate, rate / largest)
        for number, (name, rate) in enumerate(sorted(rates.items(), key=lambda one: -one[1]))
    ]
    height = ROW * len(rows) + 10
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        f'font-family="Helvetica, Arial, sans-serif" font-size="14">'
        f'<rect width="{WIDTH}" height="{height}" fill="#faf9f5"/>{"".join(rows)}</svg>'
    )


def _bar(number: int, name: str, rate: float, share: float) -> str:
    colour = "#d55e00" if "fmugym" in name else "#8a949e"
    top = ROW * number + 10
    length = max(share * (WIDTH - LABEL - 90), 1)
    escaped = name.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return (
        f'<text x="{LABEL - 10}" y="{top + 15}" text-anchor="end" fill="#1f2933">{escaped}</text>'
        f'<rect x="{LABEL}" y="{top}" width="{length:.1f}" height="20" fill="{colour}"/>'
        f'<text x="{LABEL + length + 6:.1f}" y="{top + 15}" fill="#46505c">{_short(rate)}</text>'
    )


def _short(rate: float) -> str:
    return f"{rate / 1e6:.3g} M/s" if rate >= 1e6 else f"{rate / 1e3:.3g} k/s"
