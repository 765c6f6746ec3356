"""The examples own_fmu.py and pendulum_swing_up.py, run as a reader would run them."""

import re
import shutil

import numpy as np
import pytest
from example_tools import EXAMPLES, run_example


@pytest.fixture
def torque(example):
    return example("pendulum_swing_up").torque


class TestOwnFMU:
    def test_a_copy_in_another_folder_runs_one_episode(self, tmp_path):
        """The check finds nothing, not even a parameter without effect."""
        copy = shutil.copy(EXAMPLES / "own_fmu.py", tmp_path / "copied.py")
        assert "at rest: True" in run_example(copy, folder=tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["copied.py"]


class TestPendulumSwingUp:
    def test_reaches_upright_and_stays_there(self, tmp_path):
        printed = run_example("pendulum_swing_up.py", "--seeds", 100, folder=tmp_path)
        held = [int(steps) for steps in re.findall(r"last (\d+) of 200", printed)]
        assert len(held) == 100
        assert min(held) > 100  # 5 of the 10 seconds
        assert "upright to the end in 100 of 100 episodes" in printed
        returns = [float(value) for value in re.findall(r"return +([-.\d]+),", printed)]
        assert -200 < np.mean(returns) < -100

    def test_torque_is_an_action_and_odd_in_the_state(self, torque):
        rng = np.random.default_rng(0)
        for angle, velocity in rng.uniform([-3, -8], [3, 8], (200, 2)):
            state = np.array([np.cos(angle), np.sin(angle), velocity], dtype=np.float32)
            action = torque(state)
            assert action.dtype == np.float32
            assert action.shape == (1,)
            assert abs(action[0]) <= 2.0
            assert torque(state * np.float32([1, -1, -1])) == pytest.approx(-action)

    def test_hanging_rod_at_rest_is_driven(self, torque):
        assert abs(torque(np.float32([-1.0, 0.0, 0.0]))[0]) == 2.0
