"""The example heat_house.py: four controllers in a cold week."""

from PIL import Image


def test_thinking_ahead_costs_least(example, tmp_path, capsys):
    picture = tmp_path / "house.png"
    example("heat_house").main(["--days", "2", "--candidates", "64", "--output", str(picture)])
    lines = capsys.readouterr().out.splitlines()
    costs = [float(row.split()[-6]) + float(row.split()[-3]) for row in lines[:4]]
    assert costs[2] < 0.98 * min(costs[:2])
    assert costs[3] < costs[0]  # what it stores for the third day is not paid back yet
    with Image.open(picture) as image:
        assert image.size == (900, 800)
    assert lines[4] == f"plot: {picture}"
