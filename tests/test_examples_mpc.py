"""The examples mpc_pendulum.py and mpc_cell.py: they swing the pendulum up and hold it."""

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture(name="example")
def fixture_example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    return importlib.import_module("mpc_pendulum")


def test_it_swings_up_and_holds(example):
    controller = example.PathIntegral(candidates=300)
    found = example.run(controller, 110)
    controller.envs.close()
    assert abs(np.degrees(found.angles[0])) == pytest.approx(180)
    assert example.seconds_upright(found) > 1.0
    assert np.abs(found.torques).max() <= example.TORQUE
    assert found.ahead.shape == (110, 30, 30)


def test_without_thinking_it_does_not(example):
    """The torque cannot lift the rod directly."""
    with example.SwingUp() as env:
        env.reset(seed=0)
        for _ in range(60):
            env.step(np.full(1, example.TORQUE, np.float32))
            assert np.cos(env.out["theta"]) < 0.8


def test_a_cell_of_the_lab_is_held(example):
    cell = importlib.import_module("mpc_cell")
    angles, torques = cell.run(seed=3, steps=200, candidates=300)
    assert abs(angles[0]) < 0.1
    assert np.degrees(np.abs(np.abs(angles[-100:]) - np.pi)).max() < 15.0
    assert np.abs(torques).max() <= np.float32(cell.TORQUE)


def test_the_program_draws(tmp_path):
    picture = tmp_path / "mpc.png"
    options = ["--candidates", "64", "--steps", "20", "--output", str(picture)]
    command = [sys.executable, "-W", "error", EXAMPLES / "mpc_pendulum.py", *options]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "a decision takes" in ended.stdout
    with Image.open(picture) as image:
        assert image.size == (700, 600)
        assert len(set(image.convert("L").resize((70, 60)).getdata())) > 10


@pytest.mark.parametrize("name", ["mpc_pendulum.py", "mpc_cell.py"])
def test_it_is_short(name):
    assert len((EXAMPLES / name).read_text().splitlines()) < 150
