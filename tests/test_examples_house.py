"""The example heat_house.py: three controllers in a cold week."""

from PIL import Image


def test_thinking_ahead_costs_least(example, tmp_path, capsys):
    picture = tmp_path / "house.png"
    example("heat_house").main(["--days", "2", "--candidates", "64", "--output", str(picture)])
    lines = capsys.readouterr().out.splitlines()
    costs = [float(row.split()[-6]) + float(row.split()[-3]) for row in lines[:3]]
    assert costs[0] > costs[2] < costs[1]
    with Image.open(picture) as image:
        assert image.size == (900, 800)
    assert lines[3] == f"plot: {picture}"
