"""The example two_zones.py: a plant in Python, its task, and three controllers by hand."""

from contextlib import closing

import numpy as np
import pytest

import fmugym


@pytest.fixture(name="zones")
def fixture_zones(example):
    pytest.importorskip("pythonfmu", reason="needs pythonfmu: the extra test")
    return example("two_zones")


def test_it_plays_the_controllers_by_hand(zones, tmp_path, capsys):
    rewards = zones.main(["--folder", str(tmp_path), "--episodes", "3"])
    assert "by hand" in capsys.readouterr().out
    assert len({*rewards}) == 3
    env = fmugym.load(tmp_path / "two_zones.toml")
    with closing(env):
        assert env.action_space.shape == (3,)
        assert "T_wall" not in " ".join(env.observation_names)


def test_their_laws_are_proportional(zones, tmp_path):
    env = fmugym.load(zones.make_task(tmp_path), physical=True)
    with closing(env):
        controller = zones.ByHand().bind(env)
        row = dict.fromkeys(env.observation_names, 0.0)
        row |= {"T_tank": 45.5, "T1": 20.75, "T1_set": 20.5, "T2": 19.0, "T2_set": 19.5}
        action = controller.act([*row.values()])
        assert action == pytest.approx([0.5, 0.75, 1.0])  # the last one would be 1.5


def test_a_house_at_rest_loses_what_it_gets(zones, tmp_path):
    """First law: after 60 days of the same, the heat of the heat pump leaves by all surfaces."""
    zones.make_task(tmp_path)
    inputs = {"u_hp": 0.5, "v1": 0.6, "v2": 0.4, "T_out": 2.0, "sun": 100.0, "people": 300.0}
    task = {
        "fmu": str(tmp_path / "TwoZones.fmu"),
        "time_step": "1h",
        "episode_length": "60d",
        "variables": {"dummy": {"min": 0, "max": 1}},
        "inputs": {name: str(value) for name, value in inputs.items()},
        "agent": {"actions": ["dummy"], "observations": ["T1", "T2", "T_tank", "P"]},
        "reward": "-T1",
    }
    with closing(fmugym.load(task)) as env:
        env.reset(seed=0)
        for _ in range(60 * 24):
            (one, two, tank, power), *_ = env.step(np.zeros(1, np.float32))
    wall = (450 * (one + two) + 80 * 2.0) / 980  # its own balance
    lost = 60 * (one + two - 4.0) + 80 * (wall - 2.0) + 2 * (tank - 15)
    lift = tank - 2.0
    cop = 0.85 * (6.08 - 0.09 * lift + 0.0005 * lift**2)
    assert power == pytest.approx(1500.0)
    assert lost == pytest.approx(cop * power + 300 + 3 * 100, rel=1e-4)
    assert 15 < two < one < 30


@pytest.mark.exhaustive
def test_train_beats_them(zones, tmp_path):
    """By rounds; a table of controllers that it guesses and tunes does so, too."""
    import zones_figures

    path = zones.make_task(tmp_path)
    hand = zones_figures.by_hand(path, 12)
    facts, agent, table = zones_figures.trained(path, tmp_path / "agent", episodes=12, rounds=60)
    assert facts["baseline"] == "tuned P"
    for rewards, others in ((table, hand), (agent, table)):
        mean, half = zones_figures.gain(rewards, others)
        assert mean > half
