"""TorchRL sees what single environments would show it, as one batch."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from example_tools import run_example
from gymnasium import spaces

import fmugym
from fmugym import ConfigError

pytest.importorskip("torchrl", reason="needs TorchRL: the extra torchrl")
pytestmark = pytest.mark.filterwarnings("ignore")  # TorchRL's own, and those of torch

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import torch
    from tensordict import TensorDict
    from torchrl.data import Bounded, Categorical, MultiCategorical, Unbounded
    from torchrl.envs.utils import check_env_specs

    from fmugym.torchrl import FMUTorchEnv, make_torchrl_env

IDS = ["fmugym/CartPole-v0", "fmugym/Pendulum-v0", "fmugym/CloudPendulum-v0", "fmugym/House-v0"]
GOAL = {
    "fmu": {"bundled": "Pendulum"},
    "time_step": 0.02,
    "episode_length": "0.2s",
    "variables": {"tau": {"levels": [-0.01, 0.0, 0.01]}},
    "agent": {"actions": ["tau"], "observations": ["q", "q_dot"]},
    "reward": "-abs(q)",
    "costs": {"effort": "abs(tau)"},
    "parameters": {"q_0": {"distribution": "uniform", "low": -1.0, "high": 1.0}},
}


@pytest.fixture(params=IDS)
def env(request):
    env = make_torchrl_env(request.param, 3, seed=5)
    yield env
    env.close()


@pytest.mark.parametrize("break_when_any_done", [True, False])
def test_torchrls_own_check_passes(env, break_when_any_done):
    check_env_specs(env, break_when_any_done=break_when_any_done)


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
    env = make_torchrl_env(env_id, 3, seed=5)
    data = collect(env, 450)
    env.close()
    for index in range(3):
        actions = data["action"][index].numpy()
        count = len(actions)
        begun, observed, rewards, terminated, truncated = play_singly(env_id, actions, 5 + index)
        np.testing.assert_array_equal(data["observation"][index].numpy(), begun[:count])
        np.testing.assert_array_equal(data["next", "observation"][index].numpy(), observed)
        np.testing.assert_array_equal(data["next", "reward"][index, :, 0].numpy(), rewards)
        np.testing.assert_array_equal(data["next", "terminated"][index, :, 0].numpy(), terminated)
        np.testing.assert_array_equal(data["next", "truncated"][index, :, 0].numpy(), truncated)


def collect(env, steps):
    """Random steps with a reset of each environment whose episode has ended."""
    here, rows = env.reset(), []
    for _ in range(steps):
        done, here = env.step_and_maybe_reset(env.rand_action(here))
        rows.append(done)
    return torch.stack(rows, dim=1)


def test_environments_that_do_not_step_stay_where_they_are():
    env = make_torchrl_env("fmugym/Pendulum-v0", 3, seed=1)
    here = env.reset()
    still = torch.tensor([True, False, True])
    for _ in range(4):
        before = here["observation"].clone()
        stepped = env.step(env.rand_action(here).set("_step", still[:, None]))
        assert torch.equal(stepped["next", "observation"][1], before[1])
        assert not torch.equal(stepped["next", "observation"][0], before[0])
        assert stepped["next", "reward"][1] == 0
        here = stepped["next"].exclude("reward")
    env.close()


def test_infos_are_keys_of_constant_shape():
    env = make_torchrl_env("fmugym/FMU-v0", 2, seed=0, infos=["cost", "other"], config=GOAL)
    assert isinstance(env.action_spec, Categorical)
    check_env_specs(env)
    here = env.reset()
    assert torch.isnan(here["other"]).all()
    here["action"] = torch.tensor([0, 1])
    np.testing.assert_allclose(env.step(here)["next", "cost"][:, 0], [0.01, 0.0])
    env.close()


def test_spaces_of_every_kind():
    from fmugym.torchrl import _spec

    size, device = torch.Size([2]), torch.device("cpu")
    bounded = _spec(spaces.Box(-1, 1, (3,)), size, device)
    assert isinstance(bounded, Bounded)
    assert bounded.shape == (2, 3)
    assert isinstance(_spec(spaces.Box(-np.inf, 1, (3,)), size, device), Unbounded)
    assert isinstance(_spec(spaces.MultiDiscrete([2, 3]), size, device), MultiCategorical)
    nested = _spec(spaces.Dict(a=spaces.MultiBinary(4), b=spaces.Discrete(3)), size, device)
    assert nested["a"].shape == (2, 4)
    with pytest.raises(ConfigError, match="Tuple"):
        _spec(spaces.Tuple([spaces.Discrete(2)]), size, device)


def test_discrete_actions_that_do_not_begin_with_0():
    class Late(fmugym.envs.CartPoleEnv):
        def _get_action_space(self):
            return spaces.Discrete(2, start=3)

        def _get_inputs(self):
            return np.where(self.action == 4, 10.0, -10.0)

    one = make_torchrl_env(Late, 2, seed=0)
    other = make_torchrl_env("fmugym/CartPole-v0", 2, seed=0)
    actions = TensorDict({"action": torch.tensor([0, 1])}, batch_size=[2])
    found = [env.step(env.reset().update(actions))["next"] for env in (one, other)]
    assert torch.equal(found[0]["observation"], found[1]["observation"])
    one.close()
    other.close()


def test_what_does_not_fit_is_refused():
    envs = fmugym.FMUVectorEnv(fmugym.envs.CartPoleEnv, 2)
    with pytest.raises(ConfigError, match=r"NEXT_STEP.*DISABLED"):
        FMUTorchEnv(envs)
    envs.close()
    with pytest.raises(ConfigError, match="list"):
        FMUTorchEnv([])
    with pytest.raises(ConfigError, match="CartPole-v1"):
        make_torchrl_env("CartPole-v1", 2)


def test_the_example_trains():
    printed = run_example("train_torchrl.py", "--steps", "20480", warnings="ignore")
    mean = float(printed.splitlines()[-1].split(":")[1].split()[0])
    assert mean > 60  # a random policy has 22
