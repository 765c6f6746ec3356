"""The page on the lab: its tables are those of the package."""

import dataclasses
import math
import re
from pathlib import Path

import pytest

from fmugym.lab import HARDWARE, IDEAL

PAGE = Path(__file__).parent.parent / "docs" / "lab.md"
ROW = re.compile(r"^\| `(\w+)` \| ([^|]+) \| ([^|]+) \| [^|]+ \|$", re.M)


def number(text):
    return {"None": None, "True": True, "False": False}.get(text) if text.isalpha() else float(text)


def values(text):
    """The entries of a cell of the table."""
    if text == "inf":
        return [math.inf]
    return [number(entry) for entry in text.strip("()").split(", ")]


def test_the_table_has_every_option_with_both_values():
    rows = ROW.findall(PAGE.read_text())
    assert [row[0] for row in rows] == [field.name for field in dataclasses.fields(IDEAL)]
    for name, *shown in rows:
        for preset, text in zip((IDEAL, HARDWARE), shown, strict=True):
            value = getattr(preset, name)
            entries = list(value) if isinstance(value, tuple) else [value]
            expected = [
                None if entry is None else pytest.approx(entry, rel=1e-5) for entry in entries
            ]
            assert values(text) == expected, name
