"""The example train_house.py: linear agents beside tuned baselines."""

import importlib
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fmugym.baselines import tune

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(name="example")
def fixture_example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    example = importlib.import_module("train_house")
    monkeypatch.setattr(example, "EPISODES", 2)
    monkeypatch.setattr(example.Evolution, "PAIRS", 8)
    monkeypatch.setattr(example, "tune", partial(few, tune))
    return example


def few(tune, *arguments, **_):
    return tune(*arguments, candidates=8, episodes=2, rounds=3)


def total(path):
    return np.sum(json.loads(path.read_text())["costs"])


def test_agents_learn_and_are_compared(example, tmp_path, capsys):
    for name in example.SEARCHES:
        example.tuned(name, tmp_path)
    example.train(0, 20, tmp_path)
    before = sum(map(sum, example.all_costs(example.Evolution(0).agent())))
    after = total(tmp_path / "agent_0.json")
    assert after < 0.8 * before
    arguments = ["--seeds", "1", "--rounds", "20", "--workers", "1", "--folder", str(tmp_path)]
    example.main(arguments)  # with what is there
    printed = capsys.readouterr().out
    assert f"{after:.2f}" in printed
    for name in ("costs", "days"):
        with Image.open(tmp_path / f"{name}.png") as image:
            assert min(image.size) > 300


def test_a_linear_agent_is_a_weighted_sum(example):
    centre, width = np.array([20.0, 30.0]), np.array([2.0, 5.0])
    rows = np.array([[22.0, 25.0], [18.0, 30.0]])
    alone = example.Linear(np.array([-0.2, 0.1, 0.3]), centre, width)._decide(rows)
    assert alone == pytest.approx([0.5 + 0.5 * (-0.2 - 0.1 + 0.3), 0.5 + 0.5 * (0.2 + 0.3)])
    each = np.array([[-0.2, 0.1, 0.3], [0.0, 0.0, 1.0]])
    both = example.Linear(each, centre, width)._decide(rows)
    assert both == pytest.approx([alone[0], 1.0])


def test_the_same_seed_gives_the_same_agent(example, monkeypatch):
    monkeypatch.setattr(example.Evolution, "PAIRS", 2)
    agents = []
    for seed in (1, 1, 2):
        evolution = example.Evolution(seed)
        evolution.advance(1, 1)
        agents.append(evolution.agent().weights)
    assert np.array_equal(agents[0], agents[1])
    assert not np.array_equal(agents[0], agents[2])
