"""What a search has to know of a task before it begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Final

import numpy as np

from fmugym.baselines.arena import MOST_STEPS
from fmugym.baselines.base import FloatArray
from fmugym.env import FMUEnv
from fmugym.search.flattening import require_numbers, rows_of
from fmugym.search.policy import Policy
from fmugym.vector import FMUVectorEnv

__all__ = ["MOST_PROBED", "Probe", "document_of"]

_EPISODES: Final = 8
_STEPS: Final = 100
"""So many episodes are compared, until all have ended, or for so many steps."""

_QUICK: Final = 2e-3
_MANY: Final = 128
_TIMED: Final = 10
"""If a step takes less than this in seconds, so many environments tell its time by so many steps:
the overhead of a call is for all of them."""

MOST_PROBED: Final = _EPISODES * _STEPS + _MANY * _TIMED
"""The steps of a probe, at most. As many count, since how many there are depends on the time."""


@dataclass(frozen=True)
class Probe:
    """What is known of a task.

    Attributes:
        names: What is observed.
        actions: The action space, in words.
        acting: How many numbers choose an action.
        ranges: The lowest and the highest value of each number; empty if actions are chosen.
        limits: What each cost may add up to in an episode.
        document: What the task declares; empty if it is no declared one.
        length: The steps of an episode; None if they are not limited.
        is_same: Whether all episodes are the same.
        seconds: Real time of a step of one environment among many.
        only_reward: The reward of every step; None if it has changed, or an episode has ended by
            success or failure.
    """

    names: tuple[str, ...]
    actions: str
    acting: int
    ranges: tuple[tuple[float, float], ...]
    limits: Mapping[str, float]
    document: Mapping[str, Any]
    length: int | None
    is_same: bool
    seconds: float
    only_reward: float | None

    @classmethod
    def of(cls, make_env: Callable[[], FMUEnv], envs: int = _EPISODES) -> Probe:
        """Take some steps with random actions, which are the same in all environments.

        Args:
            make_env: A function that makes the environment.
            envs: The largest number of environments.

        Raises:
            ConfigError: If no policy can be searched for the task.
        """
        with closing(make_env()) as env:
            require_numbers(env.observation_space, env.action_space)
            policy = Policy(None).bind(env)
            limit = env.spec.max_episode_steps if env.spec is not None else None
            length = env.config.max_episode_steps or limit
            limits = dict(getattr(env, "cost_limits", {}))
            document = document_of(env)
        with closing(FMUVectorEnv(make_env, min(envs, _EPISODES))) as many:
            told, seconds = _timed(many, _EPISODES, _STEPS)
        if seconds < _QUICK:
            with closing(FMUVectorEnv(make_env, min(envs, _MANY))) as many:
                _, seconds = _timed(many, 1, _TIMED)
        rewards, has_ended = np.unique(told[1:, :, 0]), told[:, :, 1].any()
        return cls(
            policy.names,
            str(policy.space),
            policy.acting,
            policy.limits,
            limits,
            document,
            length,
            is_same=bool((told == told[:, :1]).all()),
            seconds=seconds,
            only_reward=float(rewards[0]) if len(rewards) == 1 and not has_ended else None,
        )

    @property
    def most_steps(self) -> int:
        """The steps after which an episode is stopped."""
        return self.length or MOST_STEPS

    def round_time(self, candidates: int, episodes: int) -> float:
        """About how many seconds a round takes."""
        return self.seconds * self.most_steps * candidates * episodes


def document_of(env: Any) -> Mapping[str, Any]:
    """What the task of an environment declares; empty if it is no declared one."""
    return env.task.document if hasattr(env, "task") else {}


def _timed(envs: FMUVectorEnv, episodes: int, most: int) -> tuple[FloatArray, float]:
    """What ``_played`` tells of so many episodes, and the seconds of a step.

    Few environments play several times, so that their number does not matter.
    """
    count, begin = envs.num_envs, perf_counter()
    played = [_played(envs, first, most) for first in range(0, max(count, episodes), count)]
    steps = sum(len(one) - 1 for one in played) * count
    seconds = (perf_counter() - begin) / steps
    shortest = min(map(len, played))
    told = np.concatenate([one[:shortest] for one in played], axis=1)
    return told[:, :episodes], seconds


def _played(envs: FMUVectorEnv, first: int, most: int) -> FloatArray:
    """Reward, both kinds of ends and the observation after each step: shape (1 + steps, N, k).

    They are for episodes from the seed ``first`` on, until one of them ends, or for as many steps
    as there may be. The first row is that of the reset.
    """
    space, count = envs.single_observation_space, envs.num_envs
    envs.single_action_space.seed(0)
    observations, _ = envs.reset(seed=list(range(first, first + count)))
    told = [np.zeros((count, 3))]
    seen = [rows_of(space, observations, count)]
    while len(told) <= most and not told[-1][:, 1:].any():
        action = envs.single_action_space.sample()
        observations, rewards, terminated, truncated, _ = envs.step(np.array([action] * count))
        seen.append(rows_of(space, observations, count))
        told.append(np.stack([rewards, terminated, truncated], axis=1))
    return np.concatenate([told, seen], axis=2)
