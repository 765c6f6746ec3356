"""The example mpc_pendulum.py: it swings the pendulum up and holds it."""

import numpy as np
import pytest
from example_tools import run_example
from PIL import Image


@pytest.fixture(name="mpc")
def fixture_mpc(example):
    return example("mpc_pendulum")


def test_it_swings_up_and_holds(mpc):
    found = mpc.run(mpc.planner(300), 110)
    assert abs(np.degrees(found.angles[0])) == pytest.approx(180)
    assert mpc.seconds_upright(found) > 1.0
    assert np.abs(found.torques).max() <= mpc.TORQUE


def test_without_thinking_it_does_not(mpc):
    """The torque cannot lift the rod directly."""
    with mpc.SwingUp() as env:
        env.reset(seed=0)
        for _ in range(60):
            env.step(np.full(1, mpc.TORQUE, np.float32))
            assert np.cos(env.out["theta"]) < 0.8


def test_the_program_draws(tmp_path):
    picture = tmp_path / "mpc.png"
    options = "--candidates", "64", "--steps", "20", "--output", picture
    printed = run_example("mpc_pendulum.py", *options, folder=tmp_path)
    assert "a decision takes" in printed
    with Image.open(picture) as image:
        assert image.size == (700, 600)
        assert len(set(image.convert("L").resize((70, 60)).getdata())) > 10
