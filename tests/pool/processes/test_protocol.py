"""Codes of the worker protocol: the same in Python, in C, and in the tables of CONTRIBUTING.md."""

import re
from pathlib import Path

import pytest

from fmugym.pool.engine import Answer, Request

ROOT = Path(__file__).parents[3]
HEADER = (ROOT / "native" / "pool" / "requests.h").read_text()
PAGE = (ROOT / "CONTRIBUTING.md").read_text()


def codes_in_c(name):
    """The codes of an enumeration by name, without its prefix."""
    (body,) = re.findall(rf"typedef enum \{{([^}}]*)\}} {name};", HEADER)
    lines = re.findall(rf"^ +{name.upper()}_(\w+)(?: = '(.)')?", body, re.MULTILINE)
    return {one: ord(letter) if letter else place for place, (one, letter) in enumerate(lines)}


@pytest.mark.parametrize("codes", [Request, Answer])
def test_python_and_c_agree(codes):
    assert codes_in_c(codes.__name__) == {one.name: one.value for one in codes}


@pytest.mark.parametrize("codes", [Request, Answer])
def test_the_page_has_all(codes):
    (table,) = re.findall(rf"^\| {codes.__name__.lower()} \|.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert re.findall(r"^\| `(\w+)`", table, re.MULTILINE) == [one.name for one in codes]
