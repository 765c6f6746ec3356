"""Proximal policy optimization (PPO) in one file: read it, change it.

    python examples/ppo.py  # needs PyTorch: pip install -e ".[torch]"
    python examples/ppo.py --env_id fmugym/Pendulum-v0 --target -200 --hidden 64,64 --share False \
        --normalize True --gamma 0.9 --learning_rate 2e-3 --minibatches 8

For vector environments of Gymnasium with flat observations, and discrete actions or a box. The
method is that of Schulman et al., arXiv:1707.06347, with the advantages of arXiv:1506.02438.
"""

from __future__ import annotations

import argparse
from ast import literal_eval
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import chain, pairwise
from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, Normal

import fmugym  # noqa: F401  (registers its environments)

HELD_OUT_SEED = 1_000_000  # no training uses seeds from here on


@dataclass(frozen=True)
class Settings:
    """What to train, and how; each is an option of the command line."""

    env_id: str = "fmugym/CartPole-v0"
    seed: int = 0
    steps: int = 300_000  # of all environments together, at most
    target: float = 485.0  # the training ends when 100 episodes have this mean return
    num_envs: int = 64
    rollout: int = 32  # steps of each environment between two updates of the network
    epochs: int = 8  # how often an update uses each step
    minibatches: int = 4  # parts of the steps, each of which moves the weights once
    learning_rate: float = 5e-3  # of Adam; it falls to 0 at the last step
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2  # an update may change the odds of an action by this share
    hidden: tuple[int, ...] = (64,)  # widths of the layers
    share: bool = True  # whether policy and value share them
    normalize: bool = False  # whether observations and rewards are divided by their spread


class Scale:
    """The running mean and spread of values along the first axis (Chan, Golub, LeVeque, 1983)."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._count, self._variance = 1e-4, np.ones(shape)
        self.mean, self.spread = np.zeros(shape), np.ones(shape)

    def update(self, values: NDArray[Any]) -> None:
        """Take in more values."""
        self._count += len(values)
        share, shift = len(values) / self._count, values.mean(0) - self.mean
        self.mean = self.mean + share * shift
        change = values.var(0) + (1 - share) * shift**2 - self._variance
        self._variance = self._variance + share * change
        self.spread = np.sqrt(self._variance) + 1e-8


class Agent(nn.Module):
    """A network; of a box of actions it gives means, from -1 to 1 for the limits of the box."""

    def __init__(self, envs: gym.vector.VectorEnv, settings: Settings) -> None:
        super().__init__()
        observed, self._space = envs.single_observation_space, envs.single_action_space
        self._is_discrete = isinstance(self._space, gym.spaces.Discrete)
        width = int(self._space.n if self._is_discrete else np.prod(self._space.shape))
        widths = [*observed.shape, *settings.hidden]
        self._body = layers(widths)
        self._value_body = self._body if settings.share else layers(widths)
        self._actor = linear(widths[-1], width, 0.01)  # at first, all actions are alike
        self._critic = linear(widths[-1], 1, 1.0)
        self._log_std = nn.Parameter(torch.full((width,), -0.5))
        self.scale = Scale(observed.shape)

    def forward(self, observations: Tensor) -> tuple[Distribution, Tensor]:
        """The distributions of the actions, and the values."""
        features = self._body(observations)
        judged = features if self._value_body is self._body else self._value_body(observations)
        parameters, values = self._actor(features), self._critic(judged).squeeze(-1)
        if self._is_discrete:
            return Categorical(logits=parameters, validate_args=False), values
        normal = Normal(parameters, self._log_std.exp(), validate_args=False)
        return Independent(normal, 1, validate_args=False), values

    def prepared(self, observations: NDArray[Any]) -> Tensor:
        """Observations as the network takes them."""
        scaled = (observations - self.scale.mean) / self.scale.spread
        return torch.as_tensor(scaled, dtype=torch.float32)

    def for_env(self, actions: Tensor) -> NDArray[Any]:
        """Actions as the environments take them."""
        if self._is_discrete:
            return actions.numpy() + self._space.start
        low, high = self._space.low, self._space.high
        shares = (actions.numpy().reshape(-1, *low.shape) + 1) / 2
        return np.clip(low + shares * (high - low), low, high)

    @torch.no_grad()
    def act(self, observations: NDArray[Any], info: Any = None) -> NDArray[Any]:
        """The best actions for observations of shape (N, k)."""
        return self.for_env(self(self.prepared(observations))[0].mode)


def layers(widths: Sequence[int]) -> nn.Sequential:
    """The hidden layers."""
    pairs = [(linear(a, b, 2**0.5), nn.Tanh()) for a, b in pairwise(widths)]
    return nn.Sequential(*chain.from_iterable(pairs))


def linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    """A layer that begins as PPO's do."""
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Player:
    """Plays on in all environments and notes what happens: arrays of shape (steps, N, ...)."""

    def __init__(self, settings: Settings, agent: Agent, envs: gym.vector.VectorEnv) -> None:
        self._settings, self._agent, self._envs = settings, agent, envs
        shape = settings.rollout, envs.num_envs
        self._seen = np.zeros((shape[0] + 1, *envs.observation_space.shape), dtype=np.float32)
        self._seen[-1], _ = envs.reset(seed=settings.seed)
        self._rewards, self._terminated, self._ended = np.zeros(shape), *np.zeros((2, *shape), bool)
        self._returns, self._reward_scale = np.zeros(envs.num_envs), Scale(())

    @torch.no_grad()
    def play(self) -> tuple[Tensor, ...]:
        """Return observations, actions, log probabilities, advantages and returns, by rows.

        After its end an environment is reset in the next step, whose action has no effect. Such
        steps are left out. The network says what a truncation has cut off.
        """
        agent, envs, seen, actions = self._agent, self._envs, self._seen, []
        before = self._ended[-1].copy()
        seen[0] = seen[-1]
        for t in range(self._settings.rollout):
            actions.append(agent(agent.prepared(seen[t]))[0].sample())
            result = envs.step(agent.for_env(actions[-1]))
            seen[t + 1], self._rewards[t], self._terminated[t], truncated, _ = result
            self._ended[t] = self._terminated[t] | truncated
        observations, taken = agent.prepared(seen), torch.stack([*actions, actions[-1]])
        decisions, values = agent(observations)
        advantages = torch.as_tensor(self._advantages(values.numpy()), dtype=torch.float32)
        parts = observations, taken, decisions.log_prob(taken), advantages, advantages + values[:-1]
        if self._settings.normalize:
            self._update_scales()
        used = ~torch.as_tensor(np.vstack([before, self._ended[:-1]]))
        return tuple(part[: len(used)][used] for part in parts)

    def _advantages(self, values: NDArray[Any]) -> NDArray[Any]:
        settings, advantages = self._settings, np.zeros_like(self._rewards)
        following = np.zeros(self._envs.num_envs)
        for t in reversed(range(settings.rollout)):
            later = settings.gamma * values[t + 1] * ~self._terminated[t]
            following *= settings.gamma * settings.gae_lambda * ~self._ended[t]
            following += self._rewards[t] / self._reward_scale.spread + later - values[t]
            advantages[t] = following
        return advantages

    def _update_scales(self) -> None:
        """Rewards are divided by the spread of their discounted sums until now."""
        self._agent.scale.update(self._seen[1:].reshape(-1, *self._seen.shape[2:]))
        for rewards, ended in zip(self._rewards, self._ended, strict=True):
            self._returns = self._returns * self._settings.gamma + rewards
            self._reward_scale.update(self._returns)
            self._returns *= ~ended


def train(settings: Settings, tell: Callable[[int, float, Agent], Any]) -> Agent:
    """Train an agent. `tell` gets the steps, the mean return and the agent now and then."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)
    envs, judges = (gym.make_vec(settings.env_id, n) for n in (settings.num_envs, 100))
    agent = Agent(envs, settings)
    player = Player(settings, agent, envs)
    optimizer = torch.optim.Adam(agent.parameters(), settings.learning_rate, eps=1e-5, fused=True)
    size = settings.rollout * settings.num_envs
    updates = settings.steps // size
    for number in range(1, updates + 1):
        improve(settings, agent, optimizer, player.play())
        optimizer.param_groups[0]["lr"] = settings.learning_rate * (1 - number / updates)
        if number % max(5, updates // 30) == 0 or number == updates:
            mean = float(evaluate(agent, judges, HELD_OUT_SEED).mean())
            tell(number * size, mean, agent)
            if mean >= settings.target:
                break
    envs.close()
    judges.close()
    return agent


def improve(settings: Settings, agent: Agent, optimizer: Any, data: tuple[Tensor, ...]) -> None:
    """Move the weights along the clipped objective, several times over all steps."""
    for _ in range(settings.epochs):
        for rows in torch.randperm(len(data[0])).chunk(settings.minibatches):
            observations, actions, old_logs, advantages, returns = (part[rows] for part in data)
            decisions, values = agent(observations)
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
            odds = (decisions.log_prob(actions) - old_logs).exp()
            clipped = odds.clamp(1 - settings.clip, 1 + settings.clip)
            gain = torch.minimum(odds * advantages, clipped * advantages).mean()
            optimizer.zero_grad()
            (0.25 * (values - returns).square().mean() - gain).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def evaluate(agent: Agent, envs: gym.vector.VectorEnv, seed: int) -> NDArray[np.float64]:
    """The return of one episode in each environment, with the best actions."""
    observations, _ = envs.reset(seed=seed)
    returns, running = np.zeros(envs.num_envs), np.ones(envs.num_envs, dtype=bool)
    while running.any():
        observations, rewards, terminated, truncated, _ = envs.step(agent.act(observations))
        returns += np.where(running, rewards, 0.0)
        running &= ~(terminated | truncated)
    return returns


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, and play 100 episodes that had no part in the training."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for field in fields(Settings):
        read = str if field.type == "str" else literal_eval
        parser.add_argument(f"--{field.name}", default=field.default, type=read)
    settings = Settings(**vars(parser.parse_args(arguments)))
    begin = perf_counter()
    agent = train(settings, lambda steps, mean, _: print(f"{steps} steps: mean return {mean:.1f}"))
    seconds = perf_counter() - begin
    returns = evaluate(agent, gym.make_vec(settings.env_id, 100), HELD_OUT_SEED + 100)
    print(f"100 other episodes: mean return {returns.mean():.1f}; trained in {seconds:.2f} s")


if __name__ == "__main__":
    main()
