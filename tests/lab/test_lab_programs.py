"""Whole programs in the lab: one in the form of the published tutorial, and the examples."""

import re

import numpy as np
import pytest
from example_tools import run_example
from lab_tools import ideal_lab

from fmugym.lab import Lab, ManualClock

LENGTH = 0.10  # m
TOLERANCE = 0.03
LABS = {"imperfect": (Lab, TOLERANCE), "ideal": (ideal_lab, 0.015)}

FOR_THE_REAL_LAB = """
import time
from pathlib import Path
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from cloudpendulumclient.client import Client
from cloudpendulumclient.data import CellType

def fall(angle):
    cell, rows = Client(), []
    token, _ = cell.start_episode(gym, "SimplePendulum", 5, 0.0, initial_position=[angle])
    cell.set_impedance_controller_params([0.0], [0.0], token)
    begin = time.time()
    while len(rows) < 250:
        rows.append((cell.get_position(token), cell.get_velocity(token)))
        time.sleep(max(0.0, begin + 0.02 * len(rows) - time.time()))
    cell.stop_episode(token)
    return np.array(rows)

user = Path("~/.env").expanduser().read_text().strip()
info = Client().get_user_info(user)
print(info.number_of_attempts, info.max_gym_length, info.gym_bucket_size, info.gym_max_bucket_size)
gym = Client().start_gym(user, 30, [CellType.SINGLE] * 4)
with ThreadPoolExecutor(4) as four:
    rows = np.array(list(four.map(fall, np.random.default_rng(0).uniform(-np.pi, np.pi, 12))))
Client().stop_gym(gym)
velocity, sine = rows[:, 1:-1, 1].ravel(), np.sin(rows[:, 1:-1, 0]).ravel()
acceleration = (rows[:, 2:, 1] - rows[:, :-2, 1]).ravel() / 0.04
p1, p2 = np.linalg.lstsq(np.column_stack([-velocity, -sine]), acceleration, rcond=None)[0]
print("length", 9.81 / p2)
"""


@pytest.mark.realtime
def test_a_program_for_the_real_lab_runs_with_another_import(tmp_path, temp_root):
    """Twelve swings on four cells of the default lab, in real time and at 50 Hz."""
    (tmp_path / ".env").write_text("my token\n")
    (tmp_path / "program.py").write_text(
        FOR_THE_REAL_LAB.replace("cloudpendulumclient", "fmugym.lab")
    )
    home = {"HOME": str(tmp_path), "USERPROFILE": str(tmp_path)}
    printed = run_example(tmp_path / "program.py", folder=tmp_path, **home)
    assert printed.startswith("1000 3600.0 20 20\n")
    length = float(printed.rpartition("length ")[2])
    assert length == pytest.approx(LENGTH, rel=TOLERANCE)
    assert list(temp_root.iterdir()) == []


@pytest.fixture(name="identification")
def fixture_identification(example):
    return example("lab_identification")


class TestIdentification:
    @pytest.mark.parametrize("kind", LABS)
    @pytest.mark.parametrize("seed", range(4))
    def test_finds_the_length(self, identification, kind, seed):
        make_lab, tolerance = LABS[kind]
        angles = np.random.default_rng(seed).uniform(-np.pi, np.pi, 12)
        clock = ManualClock()
        with make_lab(clock=clock, seed=seed):
            swings = identification.collect("my token", angles, clock)
        assert len(swings) == 12
        assert clock.time() < 30.0
        _, p2 = identification.fit(swings)
        assert 9.81 / p2 == pytest.approx(LENGTH, rel=tolerance)

    def test_ideal_cells_give_the_viscous_friction(self, identification):
        clock = ManualClock()
        with ideal_lab(clock=clock):
            p1, _ = identification.fit(identification.collect("t", [2.0, 1.0, -1.5, -2.5], clock))
        assert p1 == pytest.approx(4e-4 / 6e-4, rel=0.02)

    def test_coulomb_regressor_removes_most_of_the_bias(self, identification):
        clock = ManualClock()
        with Lab(clock=clock, seed=0):
            swings = identification.collect("t", np.linspace(-3.0, 3.0, 12), clock)
        biased, _ = identification.fit(swings)
        better, _, coulomb = identification.fit(swings, with_coulomb=True)
        truth = 4e-4 / 6e-4
        assert abs(better - truth) < 0.4 * abs(biased - truth)
        assert 1e-3 < coulomb * 6e-4 < 4e-3

    def test_as_a_program(self, tmp_path):
        printed = run_example("lab_identification.py", "--fast", folder=tmp_path)
        assert "12 swings" in printed
        lengths = [float(cm) / 100 for cm in re.findall(r"length = ([.\d]+) cm", printed)]
        assert lengths == pytest.approx([LENGTH] * 2, rel=TOLERANCE)
        assert list(tmp_path.iterdir()) == []
