"""Tables in plain text that is valid Markdown."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

__all__ = ["Table", "duration", "rate", "share", "times"]


@dataclass
class Table:
    """A table.

    Attributes:
        title: The text above the table.
        header: The names of the columns.
        rows: The cells.
        data: The same figures, not rounded, for programs.
    """

    title: str
    header: list[str]
    rows: list[list[str]] = field(default_factory=list)
    data: list[dict[str, Any]] = field(default_factory=list)

    def __str__(self) -> str:
        widths = [max(map(len, column)) for column in zip(self.header, *self.rows, strict=True)]
        rule = [":" + "-" * (widths[0] - 1), *("-" * (width - 1) + ":" for width in widths[1:])]
        lines = [_line(cells, widths) for cells in (self.header, rule, *self.rows)]
        return "\n".join([self.title, "", *lines])


def _line(cells: list[str], widths: list[int]) -> str:
    first, *others = zip(cells, widths, strict=True)
    padded = [first[0].ljust(first[1]), *(cell.rjust(width) for cell, width in others)]
    return f"| {' | '.join(padded)} |"


def _three_digits(value: float) -> str:
    """Format with at least three significant digits and without an exponent."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"


def rate(value: float) -> str:
    """Format a number per second: 1.23 M, 45.6 k."""
    for factor, unit in ((1e6, " M"), (1e3, " k")):
        if value >= factor:
            return _three_digits(value / factor) + unit
    return _three_digits(value)


def times(value: float) -> str:
    """Format a ratio: 1.23x."""
    return _three_digits(value) + "x"


def share(value: float) -> str:
    """Format a part of a whole: 45 %."""
    return f"{100 * value:.0f} %"


def duration(seconds: float) -> str:
    """Format a time: 1.23 us, 45.6 ms."""
    for factor, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "us")):
        if seconds >= factor:
            return f"{_three_digits(seconds / factor)} {unit}"
    return f"{_three_digits(seconds * 1e9)} ns"
