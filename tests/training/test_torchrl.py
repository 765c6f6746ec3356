"""TorchRL's own wrapper shows what single environments would show, as one batch."""

import warnings

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("torchrl", reason="needs TorchRL")
pytestmark = pytest.mark.filterwarnings("ignore")  # TorchRL's own, and those of torch

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import torch
    from torchrl.envs import GymWrapper
    from torchrl.envs.utils import check_env_specs

IDS = ["fmugym/CartPole-v0", "fmugym/Pendulum-v0", "fmugym/CloudPendulum-v0", "fmugym/House-v0"]


def wrapped(env_id):
    envs = gym.make_vec(env_id, num_envs=3, autoreset_mode="disabled")
    return GymWrapper(envs, categorical_action_encoding=True)


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("break_when_any_done", [True, False])
def test_torchrls_own_check_passes(env_id, break_when_any_done):
    env = wrapped(env_id)
    check_env_specs(env, break_when_any_done=break_when_any_done)
    env.close()


def play_singly(env_id, actions, seed):
    """Observations, rewards and ends of one single environment, reset where it ends."""
    with gym.make(env_id) as env:
        observation, _ = env.reset(seed=seed)
        rows = []
        for action in actions:
            begun = observation
            observation, reward, terminated, truncated, _ = env.step(action)
            rows.append((begun, observation, np.float32(reward), terminated, truncated))
            if terminated or truncated:
                observation, _ = env.reset()
    return [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.parametrize("env_id", IDS[:2])
def test_a_batch_equals_single_environments(env_id):
    env = wrapped(env_id)
    data = collect(env, 450)
    env.close()
    for index in range(3):
        actions = data["action"][index].numpy()
        begun, observed, rewards, terminated, truncated = play_singly(env_id, actions, 5 + index)
        np.testing.assert_array_equal(data["observation"][index].numpy(), begun)
        np.testing.assert_array_equal(data["next", "observation"][index].numpy(), observed)
        np.testing.assert_array_equal(data["next", "reward"][index, :, 0].numpy(), rewards)
        np.testing.assert_array_equal(data["next", "terminated"][index, :, 0].numpy(), terminated)
        np.testing.assert_array_equal(data["next", "truncated"][index, :, 0].numpy(), truncated)


def collect(env, steps):
    """Random steps with a reset of each environment whose episode has ended."""
    here, rows = env.reset(seed=5), []
    for _ in range(steps):
        done, here = env.step_and_maybe_reset(env.rand_action(here))
        rows.append(done)
    return torch.stack(rows, dim=1)
