"""The examples lqr_pendulum.py, ilqr_pendulum.py, ukf_pendulum.py and compare_pendulum.py."""

import importlib

import numpy as np
import pytest
from example_tools import EXAMPLES, run_example
from PIL import Image
from ways import in_way

PROGRAMS = {
    "lqr_pendulum.py": [],
    "ilqr_pendulum.py": ["--iterations", "3"],
    "ukf_pendulum.py": ["--steps", "12", "--candidates", "32"],
    "compare_pendulum.py": ["--generations", "2", "--candidates", "8"],
}


@pytest.fixture(name="plan", scope="module")
def fixture_plan():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        return importlib.import_module("ilqr_pendulum").optimize()


class TestLQR:
    def test_small_angles_are_as_predicted(self, example):
        lqr = example("lqr_pendulum")
        angles, torques, linear = lqr.run([0.5, 1.0], steps=40)
        assert angles == pytest.approx(linear, abs=0.01)
        assert np.abs(angles[:, -1]).max() < 0.05
        assert np.sign(torques[:, 0]).tolist() == [-1, -1]

    def test_the_torque_limits_the_angle(self, example):
        """It holds a rod up to sin(angle) = 2 N m / 5 N m at rest: 23.6 degrees."""
        angles, torques, _ = example("lqr_pendulum").run([22.0, 24.0])
        assert abs(angles[0, -1]) < 1.0
        assert abs(angles[1, -1]) > 45.0
        assert np.abs(torques).max() <= 2.0


class TestIterativeLQR:
    def test_plans_a_swing_up(self, plan):
        assert np.degrees(plan.states[0]) == pytest.approx([-180.0, 0.0])
        assert np.cos(plan.states[-1, 0]) > np.cos(np.radians(1.0))
        assert np.all(np.diff(plan.costs) < 0)
        assert np.abs(plan.torques).max() <= 2.0

    def test_no_torque_alone_is_better(self, plan, example):
        """The plan is a minimum: single torques that are moved make it no cheaper."""
        ilqr = example("ilqr_pendulum")
        envs = ilqr.fmugym.FMUVectorEnv(in_way("arrays", ilqr.SwingUp), 40)
        envs.reset(seed=0)
        moved = np.repeat(plan.torques[None], 40, axis=0)
        moved[np.arange(40), np.arange(0, 80, 2), 0] += 0.05
        moved = np.clip(moved, -2, 2).astype(np.float32)
        found = envs.rollout(envs.save_state(0), moved).observations
        first = np.tile(plan.states[:1], (40, 1, 1))
        costs = ilqr.cost(np.concatenate([first, found], axis=1), moved)
        assert costs.min() > plan.costs[-1] - 0.1
        envs.close()

    def test_feedback_makes_the_plan_robust(self, plan, example):
        ilqr = example("ilqr_pendulum")
        heavy = 1.05 * ilqr.PLANT["m"]
        with_it, without = (ilqr.follow(plan, feedback, heavy) for feedback in (True, False))
        assert np.cos(np.radians(with_it[-1])) > np.cos(np.radians(2.0))
        assert np.cos(np.radians(without[-1])) < np.cos(np.radians(45.0))
        same = ilqr.follow(plan, False, ilqr.PLANT["m"])
        assert same == pytest.approx(np.degrees(plan.states[1:, 0]), abs=1e-3)


class TestKalmanFilter:
    def test_feeds_the_controller(self, example):
        ukf = example("ukf_pendulum")
        found = ukf.run(ukf.Filter(), 160, 400, seed=1)
        noise, angle, velocity = found.errors
        assert np.degrees(noise) == pytest.approx(3.0, rel=0.2)
        assert angle < 0.75 * noise
        assert velocity < 0.3
        assert found.upright > 0.9

    def test_differences_do_not(self, example):
        ukf = example("ukf_pendulum")
        found = ukf.run(ukf.Differences(), 160, 400, seed=1)
        assert found.errors[2] > 1.0
        assert found.upright < 0.5

    def test_of_a_linear_model_is_the_classical_one(self, example):
        """Near the upright position, covariances are those of the Riccati recursion."""
        ukf, lqr = example("ukf_pendulum"), example("lqr_pendulum")
        estimator = ukf.Filter()
        estimator.mean, estimator.covariance = np.zeros(2), np.diag([1e-3, 1e-3]) ** 2
        lqr.start(estimator.envs, np.zeros(5))
        snapshot = estimator.envs.save_state(0)
        step = ukf.fmugym.linearization.linearize_along(estimator.envs, snapshot, np.zeros((1, 1)))
        expected = estimator.covariance
        for _ in range(5):
            gain = expected[:, 0] / (expected[0, 0] + ukf.NOISE**2)
            expected = expected - np.outer(gain, expected[0])
            expected = step.A[0] @ expected @ step.A[0].T + np.outer(ukf.CHANGE, ukf.CHANGE)
            estimator.correct(0.0)
            estimator.predict(np.zeros(1, np.float32))
        assert estimator.covariance == pytest.approx(expected, rel=5e-3)
        assert np.abs(estimator.mean).max() < 1e-4


class TestComparison:
    def test_the_agent_learns_to_swing_up(self, example):
        compare = example("compare_pendulum")
        weights, returns = compare.train(25, seed=3)
        assert np.mean(returns[-5:]) > returns[0] + 500
        agent = compare.play(lambda envs: lambda seen: compare.policy(weights, seen))
        assert agent.upright.mean() > 0.9

    def test_linear_controllers_only_balance(self, example):
        compare = example("compare_pendulum")
        score = compare.play(lambda envs: compare.regulator(envs).act)
        assert score.upright[:5].min() == 1.0
        assert score.upright[5:].max() == 0.0


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_program_draws(name, tmp_path):
    picture = tmp_path / "picture.png"
    printed = run_example(name, *PROGRAMS[name], "--output", picture, folder=tmp_path)
    assert str(picture) in printed
    with Image.open(picture) as image:
        assert len(set(image.convert("L").resize((70, 60)).getdata())) > 10
