"""Derivatives along a trajectory, compared with those of the equations."""

import gymnasium
import numpy as np
import pytest

import fmugym
from fmugym.control.linearization import derivatives

M, L, B, G, DT = 0.06, 0.1, 1e-3, 9.81, 0.02
HORIZON = 12


class Precise(fmugym.FMUEnv):
    """The point mass by explicit Euler, one internal step for each step, seen as float64."""

    vectorized = True

    version = "2.0"
    plant = {  # noqa: RUF012  (nothing changes it)
        "m": M,
        "l": L,
        "b": B,
        "g": G,
        "body": 1,
        "solver": 1,
        "max_step": 1.0,
        "q_0": 0.4,
        "q_dot_0": 0.0,
    }

    def __init__(self, *, fmu=None, isolation=None, **changes):
        config = {
            "model_input_names": "tau",
            "model_output_names": ["q", "q_dot"],
            "model_parameters": self.plant,
            "bounds": {"tau": (-0.02, 0.02)},
            "time_step": DT,
        }
        fmu = fmu or fmugym.bundled_fmu("Pendulum", self.version)
        super().__init__(fmu, config | changes, isolation=isolation)

    def _get_observation_space(self):
        return gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def _is_done(self):
        return abs(self.out["q"]) > 9.0

    def _reward_policy(self):
        return -(self.out["q"] ** 2)


def by_hand(torques):
    """The trajectory, its derivatives by the torques, and those of the rewards."""
    state, sensitivity = np.array([0.4, 0.0]), np.zeros((2, len(torques)))
    states, by_actions, of_rewards = [], [], []
    for index, torque in enumerate(torques):
        q, v = state
        jacobian = np.array([[1, DT], [-DT * G / L * np.cos(q), 1 - DT * B / (M * L**2)]])
        state = np.array(
            [q + DT * v, v + DT * (-G / L * np.sin(q) + (torque - B * v) / (M * L**2))]
        )
        sensitivity = jacobian @ sensitivity
        sensitivity[1, index] += DT / (M * L**2)
        states.append(state)
        by_actions.append(sensitivity.copy())
        of_rewards.append(-2 * state[0] * sensitivity[0])
    return np.array(states), np.array(by_actions), np.array(of_rewards)


@pytest.fixture(name="snapshot")
def fixture_snapshot():
    with Precise() as env:
        env.reset(seed=0)
        yield env.save_state()


@pytest.mark.parametrize("num_envs", [1, 10, 64])
def test_are_those_of_the_equations(snapshot, num_envs, vector_of):
    torques = np.random.default_rng(0).uniform(-0.015, 0.015, HORIZON)
    envs = vector_of(Precise, num_envs)
    found = derivatives(envs, snapshot, torques[:, None])
    states, by_actions, of_rewards = by_hand(torques.astype(np.float32).astype(float))
    assert found.observations == pytest.approx(states, abs=1e-9)
    assert found.by_actions.shape == (HORIZON, 2, HORIZON, 1)
    assert found.by_actions[..., 0] == pytest.approx(by_actions, rel=1e-5, abs=1e-5)
    assert found.of_rewards[..., 0] == pytest.approx(of_rewards, rel=1e-4, abs=1e-4)
    assert found.of_return[:, 0] == pytest.approx(of_rewards.sum(axis=0), rel=1e-4, abs=1e-4)


def test_of_actions_at_their_bounds(snapshot, vector_of):
    envs = vector_of(Precise, 8)
    torques = np.full(HORIZON, 0.02)
    found = derivatives(envs, snapshot, torques[:, None], step=1e-4)
    _, by_actions, _ = by_hand(torques)
    assert found.by_actions[..., 0] == pytest.approx(by_actions, rel=1e-2, abs=1e-3)


def test_later_actions_have_no_influence(snapshot, vector_of):
    envs = vector_of(Precise, 8)
    found = derivatives(envs, snapshot, np.zeros((HORIZON, 1)))
    later = np.triu(np.ones((HORIZON, HORIZON), bool), 1)
    assert not found.by_actions[:, :, :, 0].transpose(0, 2, 1)[later].any()
    assert not found.of_rewards[later].any()
