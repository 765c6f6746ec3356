"""The example heat_house.py: three controllers in a cold week."""

import importlib
from pathlib import Path

import pytest
from PIL import Image

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(name="example")
def fixture_example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module("heat_house")


def test_thinking_ahead_costs_least(example, tmp_path, capsys):
    picture = tmp_path / "house.png"
    example.main(["--days", "2", "--candidates", "64", "--output", str(picture)])
    lines = capsys.readouterr().out.splitlines()
    costs = [float(row.split()[-6]) + float(row.split()[-3]) for row in lines[:3]]
    assert costs[0] > costs[2] < costs[1]
    with Image.open(picture) as image:
        assert image.size == (900, 800)
    assert lines[3] == f"plot: {picture}"


def test_it_is_short():
    assert len((EXAMPLES / "heat_house.py").read_text().splitlines()) < 150
