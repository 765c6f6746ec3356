"""The example ppo.py: PPO in one file."""

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs PyTorch: the extra torch")


@pytest.fixture(name="ppo")
def fixture_ppo(example):
    return example("ppo")


def tell(steps, mean, agent):
    """Ignore how a training goes."""


def returns_of(ppo, agent, env_id, **options):
    envs = gym.make_vec(env_id, 100, **options)
    returns = ppo.evaluate(agent, envs, 3_000_000)
    envs.close()
    return returns


@pytest.mark.parametrize("env_id", ["fmugym/CartPole-v0", "CartPole-v1"])
def test_it_solves_the_cart_pole(ppo, env_id, capsys):
    ppo.main(["--env_id", env_id, "--seed", "3"])
    *trials, last = capsys.readouterr().out.splitlines()
    assert float(last.split("mean return ")[1].split(";")[0]) >= 475
    assert len(trials) > 1


def test_a_policy_is_as_good_on_gymnasiums_cart_pole(ppo):
    agent = ppo.train(ppo.Settings(seed=2), tell)
    for env_id in ("fmugym/CartPole-v0", "CartPole-v1"):
        assert returns_of(ppo, agent, env_id).mean() >= 475


def test_it_learns_continuous_actions(ppo):
    """Of the pendulum: from about -1200 to where it swings up most times."""
    options = {"steps": 100_000, "target": -500.0, "num_envs": 32, "rollout": 64, "epochs": 10}
    options |= {"minibatches": 16, "learning_rate": 1e-3, "gamma": 0.9, "hidden": (64, 64)}
    settings = ppo.Settings("fmugym/Pendulum-v0", normalize=True, share=False, **options)
    untrained = ppo.train(ppo.Settings("fmugym/Pendulum-v0", steps=0), tell)
    assert returns_of(ppo, untrained, "fmugym/Pendulum-v0").mean() < -900
    assert returns_of(ppo, ppo.train(settings, tell), "fmugym/Pendulum-v0").mean() > -600


def test_the_same_seed_gives_the_same_agent(ppo):
    few = {"steps": 2048, "num_envs": 16, "rollout": 16}
    agents = [ppo.train(ppo.Settings(seed=seed, **few), tell) for seed in (4, 4, 5)]
    first, second, third = (agent.state_dict()["_actor.weight"] for agent in agents)
    assert torch.equal(first, second)
    assert not torch.equal(first, third)


class Scripted:
    """Two environments with rewards and ends from tables; each is reset in the step after an end.

    An observation is the number of the step, and 100 more in the second environment.
    """

    num_envs = 2
    single_observation_space = gym.spaces.Box(-1e3, 1e3, (1,))
    single_action_space = gym.spaces.Discrete(2)
    observation_space = gym.spaces.Box(-1e3, 1e3, (2, 1))
    rewards = np.array([[1.0, 2.0, 3.0, 0.0, 5.0, 6.0], [7.0, 8.0, 0.0, 9.0, 1.0, 2.0]]).T
    terminated = np.array([[0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0]], dtype=bool).T
    truncated = np.array([[0, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0]], dtype=bool).T

    def reset(self, seed):
        self._t = 0
        return self._observation(), {}

    def step(self, actions):
        t, self._t = self._t, self._t + 1
        return self._observation(), self.rewards[t], self.terminated[t], self.truncated[t], {}

    def _observation(self):
        return np.array([[self._t], [self._t + 100]], dtype=np.float32)


def test_advantages_are_sums_of_temporal_differences(ppo):
    """Written forwards: delta_t + gamma lambda delta_t+1 + ..., until the episode ends."""
    settings = ppo.Settings(rollout=6, num_envs=2, gamma=0.9, gae_lambda=0.8)
    envs = Scripted()
    agent = ppo.Agent(envs, settings)
    player = ppo.Player(settings, agent, envs)
    observations, actions, logs, advantages, returns = player.play()
    assert actions.shape == logs.shape == advantages.shape == (10,)
    steps = observations[:, 0].tolist()
    assert sorted(steps) == [0, 1, 2, 4, 5, 100, 101, 103, 104, 105]  # without steps of resets
    seen = [*range(7), *range(100, 107)]
    with torch.no_grad():
        worth = {k: agent(torch.tensor([[float(k)]]))[1].item() for k in seen}

    def delta(i, t):
        later = 0.0 if envs.terminated[t, i] else 0.9 * worth[100 * i + t + 1]
        return envs.rewards[t, i] + later - worth[100 * i + t]

    for step, advantage, target in zip(steps, advantages.tolist(), returns.tolist(), strict=True):
        i, t = divmod(int(step), 100)
        over = np.flatnonzero((envs.terminated | envs.truncated)[t:, i])
        last = t + over[0] if len(over) else 5
        expected = sum(0.72 ** (k - t) * delta(i, k) for k in range(t, last + 1))
        assert advantage == pytest.approx(expected, abs=1e-4)
        assert target == pytest.approx(expected + worth[int(step)], abs=1e-4)


def test_the_scale_is_that_of_all_values(ppo):
    rng = np.random.default_rng(0)
    values = rng.normal([5.0, -300.0], [0.1, 40.0], (1000, 2))
    scale = ppo.Scale((2,))
    for part in np.array_split(values, 13):
        scale.update(part)
    assert scale.mean == pytest.approx(values.mean(0), rel=1e-5)
    assert scale.spread == pytest.approx(values.std(0), rel=2e-3)


def test_actions_of_a_box_stay_within_it(ppo):
    space = gym.spaces.Box(np.float32([-2, 0]), np.float32([2, 10]))
    observed = gym.spaces.Box(-1, 1, (3,))
    envs = SimpleNamespace(single_observation_space=observed, single_action_space=space)
    agent = ppo.Agent(envs, ppo.Settings())
    given = agent.for_env(torch.tensor([[-1.0, 1.0], [0.0, 0.0], [5.0, -5.0]]))
    assert given.tolist() == [[-2, 10], [0, 5], [2, 0]]
