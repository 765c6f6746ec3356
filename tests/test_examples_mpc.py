"""The examples mpc_pendulum.py and mpc_cell.py: they swing the pendulum up and hold it."""

import numpy as np
import pytest
from example_tools import run_example
from PIL import Image


@pytest.fixture(name="mpc")
def fixture_mpc(example):
    return example("mpc_pendulum")


def test_it_swings_up_and_holds(mpc):
    controller = mpc.PathIntegral(candidates=300)
    found = mpc.run(controller, 110)
    controller.envs.close()
    assert abs(np.degrees(found.angles[0])) == pytest.approx(180)
    assert mpc.seconds_upright(found) > 1.0
    assert np.abs(found.torques).max() <= mpc.TORQUE
    assert found.ahead.shape == (110, 30, 30)


def test_without_thinking_it_does_not(mpc):
    """The torque cannot lift the rod directly."""
    with mpc.SwingUp() as env:
        env.reset(seed=0)
        for _ in range(60):
            env.step(np.full(1, mpc.TORQUE, np.float32))
            assert np.cos(env.out["theta"]) < 0.8


def test_a_cell_of_the_lab_is_held(example):
    cell = example("mpc_cell")
    angles, torques = cell.run(seed=3, steps=200, candidates=300)
    assert abs(angles[0]) < 0.1
    assert np.degrees(np.abs(np.abs(angles[-100:]) - np.pi)).max() < 15.0
    assert np.abs(torques).max() <= np.float32(cell.TORQUE)


def test_the_program_draws(tmp_path):
    picture = tmp_path / "mpc.png"
    options = "--candidates", "64", "--steps", "20", "--output", picture
    printed = run_example("mpc_pendulum.py", *options, folder=tmp_path)
    assert "a decision takes" in printed
    with Image.open(picture) as image:
        assert image.size == (700, 600)
        assert len(set(image.convert("L").resize((70, 60)).getdata())) > 10
