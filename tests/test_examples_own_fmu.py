"""The examples own_fmu.py and pendulum_swing_up.py, run as a reader would run them."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(folder, *arguments):
    command = [sys.executable, "-W", "error", *map(str, arguments)]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.fixture
def torque(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    from pendulum_swing_up import torque

    return torque


class TestOwnFMU:
    def test_a_copy_in_another_folder_runs_one_episode(self, tmp_path):
        (tmp_path / "copied.py").write_text((EXAMPLES / "own_fmu.py").read_text())
        done = run(tmp_path, "copied.py")
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""  # the check found nothing, not even a parameter without effect
        assert "at rest: True" in done.stdout
        assert [path.name for path in tmp_path.iterdir()] == ["copied.py"]

    def test_is_short_enough_to_copy(self):
        assert len((EXAMPLES / "own_fmu.py").read_text().splitlines()) <= 80


class TestPendulumSwingUp:
    def test_reaches_upright_and_stays_there(self, tmp_path):
        done = run(tmp_path, EXAMPLES / "pendulum_swing_up.py", "--seeds", 100)
        assert done.returncode == 0, done.stderr
        held = [int(steps) for steps in re.findall(r"last (\d+) of 200", done.stdout)]
        assert len(held) == 100
        assert min(held) > 100  # 5 of the 10 seconds
        assert "upright to the end in 100 of 100 episodes" in done.stdout
        returns = [float(value) for value in re.findall(r"return +([-.\d]+),", done.stdout)]
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
