"""The example that takes a policy from the FMU to cells of the lab that it has not seen."""

import gymnasium
import numpy as np
import pytest
from example_tools import EXAMPLES, run_example
from PIL import Image

import fmugym
from fmugym.control.linearization import linearize

CELLS = {
    "heavy": {"plant": {"m": 0.085}},
    "light": {"plant": {"m": 0.045}},
    "long": {"plant": {"l": 0.115}},
    "short": {"plant": {"l": 0.085}},
    "stiff": {"plant": {"c": 0.008}},
    "damped": {"plant": {"b": 1.5e-3}},
    "noisy": {"velocity_noise": (0.15, 0.15)},
    "slow": {"get_time": (2e-3, 8e-3), "set_time": (3e-3, 12e-3)},
}


@pytest.fixture(scope="module", name="example")
def fixture_example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        import pendulum_sim_to_lab

    return pendulum_sim_to_lab


@pytest.fixture(scope="module", name="model")
def fixture_model():
    return linearize(fmugym.bundled_fmu("Pendulum"))


def test_upright_on_the_hardware_in_at_least_nine_of_ten(example, model):
    """Of friction, noise and delays of the preset `hardware` the design knows only the period."""
    runs = [example.play_on_lab(model, seed, fast=True) for seed in range(10)]
    assert all(run.shape == (3, 500) for run in runs)
    assert sum(example.worst_angles(q) < 10.0 for q, *_ in runs) >= 9


@pytest.mark.parametrize("cell", CELLS)
def test_upright_on_other_cells(example, model, cell):
    q, _, torque = example.play_on_lab(model, 0, fast=True, **CELLS[cell])
    assert example.worst_angles(q) < 10.0
    assert np.abs(torque).max() <= 0.15


def test_upright_on_random_fmus(example, model):
    env = gymnasium.make_vec(example.ENV, 64, model_parameters=example.RANDOMIZED)
    q, _, _ = example.play(env, model, seed=1)
    assert np.mean(example.worst_angles(q) < 10.0) >= 0.95


def test_swings_up_with_less_torque_than_lifts(example, model):
    """Up to the horizontal it takes no more than half the weight of the horizontal pendulum."""
    q, _, torque = example.play_on_lab(model, 0, fast=True)
    assert 0 < np.abs(torque[np.abs(q) < np.pi / 2]).max() < 0.06 * 9.81 * 0.1 * 0.52


def test_rows_of_observations_are_taken_as_single_ones(example, model):
    rng = np.random.default_rng(0)
    q, velocity = rng.uniform(-np.pi, np.pi, (20, 5)), rng.normal(0, 5, (20, 5))
    rows = np.stack([np.cos(q), np.sin(q), velocity], axis=2).astype(np.float32)
    all_at_once = example.Policy(model)
    together = np.array([all_at_once(observations) for observations in rows])
    for k in range(5):
        policy = example.Policy(model)
        alone = np.array([policy(observation) for observation in rows[:, k]])
        assert together[:, k] == pytest.approx(alone, abs=1e-6)
        assert np.abs(alone).max() <= 1.0


def test_a_pendulum_that_hangs_or_whose_episode_broke_off_is_not_upright(example):
    seconds = np.arange(500) * 0.02
    assert example.worst_angles(np.zeros(500)) == 180.0
    assert example.worst_angles(np.full(400, np.pi)) == 180.0
    fallen = np.where(seconds < 6.9, 0.0, -np.radians(171.0))
    assert example.worst_angles(fallen) == pytest.approx(9.0)
    assert example.worst_angles(np.roll(fallen, 20)) == 180.0


def test_as_a_program(tmp_path):
    options = "--fast", "--seeds=2", "--envs=8", "--output=curves.png"
    printed = run_example("pendulum_sim_to_lab.py", *options, folder=tmp_path)
    assert "random FMUs: upright in 8 of 8" in printed
    assert "lab: upright in 2 of 2" in printed
    assert [path.name for path in tmp_path.iterdir()] == ["curves.png"]
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.size == (700, 450)
        seen = {colour for _, colour in picture.convert("RGB").getcolors(1 << 20)}
    assert {(31, 119, 180), (255, 127, 14)} <= seen  # matplotlib's first two: FMU, lab
