"""Two agents that learn to balance a cart-pole, in numpy and plain Python.

Both observe `(x [m], x_dot [m/s], theta [rad], theta_dot [rad/s])` and choose between action 0,
a push to the left, and action 1, a push to the right.
"""

from bisect import bisect
from collections.abc import Callable, Iterator
from math import prod, radians
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

Env = gym.Env[NDArray[Any], int]
Policy = Callable[[NDArray[Any]], int]

HALF_WIDTHS = np.array([2.4, 2.0, radians(12), 2.5])
"""The region around the middle in which a balanced cart-pole stays [m, m/s, rad, rad/s]."""


class Episode(NamedTuple):
    """The result of one episode: its length in steps and the sum of its rewards."""

    steps: int
    total_reward: float


class Agent(Protocol):
    """The methods that the training program calls."""

    def learn(self, env: Env) -> Iterator[Episode]:
        """Play and learn forever, and yield each training episode."""

    def policy(self) -> Policy:
        """Return the learnt policy, without exploration: observation in, action out."""


def play(env: Env, policy: Policy, seed: int | None = None) -> Episode:
    """Play one episode to its end.

    Args:
        env: The environment; this function resets it.
        policy: Returns the action for an observation.
        seed: Seed of the start; None continues the environment's own random numbers.

    Returns:
        The episode's length and sum of rewards.
    """
    observation, _ = env.reset(seed=seed)
    steps, total_reward, over = 0, 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(policy(observation))
        steps += 1
        total_reward += float(reward)
        over = terminated or truncated
    return Episode(steps, total_reward)


def middle(space: Box) -> NDArray[np.float64]:
    """Return the middle of a box, where the pole stands upright; 0 along unbounded axes.

    Args:
        space: The observation space. Upright is pi/2 in one cart-pole and 0 in another.

    Returns:
        The middle [m, m/s, rad, rad/s], of the box's shape.
    """
    bounded = space.bounded_below & space.bounded_above
    centre = np.zeros(space.shape)
    centre[bounded] = (space.low[bounded] + space.high[bounded]) / 2
    return centre


class RandomPolicy:
    """Push left or right at random.

    Args:
        seed: Seed of the random numbers.
    """

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def __call__(self, observation: NDArray[Any]) -> int:
        """Return 0 or 1 whatever the observation, of shape (4,)."""
        return int(self._rng.integers(2))


class QLearning:
    """Tabular Q-learning on a grid of cells over the observations.

    The agent learns one value for each cell and action (C. J. C. H. Watkins and P. Dayan,
    "Q-learning", Machine Learning 8, 1992). All values start at or slightly above
    `1 / (1 - DISCOUNT)`, the value of balancing forever with a reward of 1 per step. A tried action
    loses value, so the greedy choice moves on to untried ones, and no random actions are needed
    (optimistic initial values: R. S. Sutton and A. G. Barto, "Reinforcement Learning: An
    Introduction", 2nd edition, 2018, section 2.6).

    Args:
        space: The observation space, of shape (4,).
        seed: Seed of the first values, which decide what is tried first.

    Attributes:
        values: The table, one `[left, right]` per cell: lists, as numpy is slower for single
            numbers.
    """

    BINS = (3, 3, 6, 6)  # finer for the pole than for the cart
    LEARNING_RATE = 0.2
    DISCOUNT = 0.99

    def __init__(self, space: Box, seed: int) -> None:
        low, high = middle(space) - HALF_WIDTHS, middle(space) + HALF_WIDTHS
        limits = zip(low, high, self.BINS, strict=True)
        self._edges = [np.linspace(a, b, bins + 1)[1:-1].tolist() for a, b, bins in limits]
        excess = np.random.default_rng(seed).random((prod(self.BINS), 2))
        self.values = (1 / (1 - self.DISCOUNT) + excess).tolist()

    def learn(self, env: Env) -> Iterator[Episode]:
        """Play greedily and learn from every step."""
        while True:
            yield self._learn_episode(env)

    def policy(self) -> Policy:
        """Return the greedy policy."""
        return lambda observation: self.best_action(self.cell(observation))

    def cell(self, observation: NDArray[Any]) -> int:
        """Return the number of the cell that holds an observation, of shape (4,)."""
        number = 0
        for value, edges in zip(observation.tolist(), self._edges, strict=True):
            number = number * (len(edges) + 1) + bisect(edges, value)
        return number

    def best_action(self, cell: int) -> int:
        """Return the action with the larger value in a cell, or 0 if both are equal."""
        left, right = self.values[cell]
        return int(right > left)

    def update(self, cell: int, action: int, reward: float, next_cell: int | None) -> None:
        """Move one value towards the reward plus the discounted best value of the next cell.

        Args:
            cell: The cell in which the action was taken.
            action: The action taken.
            reward: The reward received.
            next_cell: The next cell; None if the episode terminated.
        """
        future = 0.0 if next_cell is None else max(self.values[next_cell])
        error = reward + self.DISCOUNT * future - self.values[cell][action]
        self.values[cell][action] += self.LEARNING_RATE * error

    def _learn_episode(self, env: Env) -> Episode:
        observation, _ = env.reset()
        cell, steps, total_reward, over = self.cell(observation), 0, 0.0, False
        while not over:
            action = self.best_action(cell)
            observation, reward, terminated, truncated, _ = env.step(action)
            next_cell = self.cell(observation)
            self.update(cell, action, float(reward), None if terminated else next_cell)
            cell, over = next_cell, terminated or truncated
            steps += 1
            total_reward += float(reward)
        return Episode(steps, total_reward)


class LinearPolicy:
    """Push right if a weighted sum of the scaled observation is positive.

    Args:
        weights: One weight per observation, of shape (4,). A common factor has no effect.
        centre: The observation of the balanced cart-pole [m, m/s, rad, rad/s], of shape (4,).
    """

    def __init__(self, weights: NDArray[np.float64], centre: NDArray[np.float64]) -> None:
        self._gains = weights / HALF_WIDTHS
        self._threshold = self._gains @ centre

    def __call__(self, observation: NDArray[Any]) -> int:
        """Return the action for an observation, of shape (4,)."""
        return int(self._gains @ observation > self._threshold)


class RandomSearch:
    """Augmented random search for the weights of a linear policy.

    Each iteration draws several random directions. For each direction, it plays one episode with
    the weights shifted along it and one with the weights shifted against it. Then it moves the
    weights along each direction by the difference of the two returns, in units of the standard
    deviation of all returns (H. Mania, A. Guy and B. Recht, "Simple random search of static linear
    policies is competitive for reinforcement learning", NeurIPS 2018, algorithm 1, version V1 with
    all directions used).

    Args:
        space: The observation space, of shape (4,).
        seed: Seed of the directions.

    Attributes:
        weights: The weights of the linear policy, of shape (4,).
    """

    DIRECTIONS = 8
    NOISE = 0.1
    STEP_SIZE = 0.1  # equal to the noise: only the ratio of the two affects the actions

    def __init__(self, space: Box, seed: int) -> None:
        self._centre = middle(space)
        self._rng = np.random.default_rng(seed)
        self.weights = np.zeros(4)

    def learn(self, env: Env) -> Iterator[Episode]:
        """Play a pair of episodes along every direction, then move the weights."""
        while True:
            directions = self._rng.normal(size=(self.DIRECTIONS, 4))
            returns = np.empty((self.DIRECTIONS, 2))
            for index, direction in enumerate(directions):
                for side, sign in enumerate((1, -1)):
                    weights = self.weights + sign * self.NOISE * direction
                    episode = play(env, LinearPolicy(weights, self._centre))
                    returns[index, side] = episode.total_reward
                    yield episode
            self.update(directions, returns)

    def policy(self) -> Policy:
        """Return the linear policy with the current weights."""
        return LinearPolicy(self.weights, self._centre)

    def update(self, directions: NDArray[np.float64], returns: NDArray[np.float64]) -> None:
        """Move the weights towards the directions with higher returns.

        Args:
            directions: The directions tried, of shape (n, 4).
            returns: The returns along and against each direction, of shape (n, 2).
        """
        spread = returns.std()
        if spread > 0:
            gradient = (returns[:, 0] - returns[:, 1]) @ directions / len(directions)
            self.weights = self.weights + self.STEP_SIZE / spread * gradient
