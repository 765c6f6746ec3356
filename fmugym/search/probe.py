"""What a search has to know of a task before it begins."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any, Final

import numpy as np

from fmugym.baselines.arena import MOST_STEPS, Arena, Outcome
from fmugym.env import FMUEnv
from fmugym.search.flattening import require_numbers
from fmugym.search.guessing import guessed_controllers
from fmugym.search.policy import Form, Policy
from fmugym.search.search import FEW

__all__ = ["MOST_PROBED", "Probe", "task_of"]

_ACTIONS: Final = 2
_EPISODES: Final = 4
_STEPS: Final = 100
"""So many constant actions play so many episodes, until their ends or for so many steps."""

_QUICK: Final = 2e-3
_TIMED: Final = 25
"""If a step takes less than this in seconds, as many candidates as in a round tell its time by so
many steps: the overhead of a call is for all of them."""

MOST_PROBED: Final = _EPISODES * (_ACTIONS * _STEPS + FEW * _TIMED)
"""The steps of a probe, at most. As many count, since how many there are depends on the time."""


@dataclass(frozen=True)
class Probe:
    """What is known of a task.

    Attributes:
        task: See ``task_of``.
        acting: How many numbers choose an action.
        ranges: The lowest and the highest value of each number; empty if actions are chosen.
        guesses: Texts of controllers that suggest themselves.
        limits: What each cost may add up to in an episode.
        length: The steps of an episode; None if they are not limited.
        is_same: Whether all episodes are the same.
        only_return: What has been reached by all actions in all episodes; None if that differs.
        seconds: Real time of a step of one environment among many.
    """

    task: Mapping[str, Any]
    acting: int
    ranges: tuple[tuple[float, float], ...]
    guesses: Sequence[str]
    limits: Mapping[str, float]
    length: int | None
    is_same: bool
    only_return: float | None
    seconds: float

    @classmethod
    def of(cls, make_env: Callable[[], FMUEnv], envs: int) -> Probe:
        """Take some steps with constant actions.

        Args:
            make_env: A function that makes the environment.
            envs: The largest number of environments.

        Raises:
            ConfigError: If no policy can be searched for the task.
        """
        with closing(make_env()) as env:
            require_numbers(env.observation_space, env.action_space)
            policy, task = Policy(None).bind(env), task_of(env)
            guesses = guessed_controllers(task, env)
            limit = env.spec.max_episode_steps if env.spec is not None else None
            length = env.config.max_episode_steps or limit
            limits = dict(getattr(env, "cost_limits", {}))
        form = Form("constant action", len(policy.names), policy.acting)
        rows = form.constants(np.random.default_rng(0).uniform(-1, 1, (FEW, form.acting)))
        scale = np.zeros(form.features), np.ones(form.features)
        make = partial(Policy, None, form, scale=scale)

        def play(actions: int, most_steps: int) -> tuple[Outcome, float]:
            seeds, watch = range(_EPISODES), attrgetter("moments")
            with closing(Arena(make_env, envs, most_steps)) as arena:
                outcome = arena.play(make, rows[:actions], seeds, watch)
                return outcome, arena.seconds / arena.steps

        (returns, _, moments), seconds = play(_ACTIONS, _STEPS)
        if seconds < _QUICK:
            _, seconds = play(FEW, _TIMED)
        return cls(
            task,
            policy.acting,
            policy.limits,
            guesses,
            limits,
            length,
            is_same=bool((returns == returns[:, :1]).all() and (moments == moments[:, :1]).all()),
            only_return=float(returns[0, 0]) if (returns == returns[0, 0]).all() else None,
            seconds=seconds,
        )

    @property
    def most_steps(self) -> int:
        """The steps after which an episode is stopped."""
        return self.length or MOST_STEPS

    def round_time(self, candidates: int, episodes: int) -> float:
        """About how many seconds a round takes."""
        return self.seconds * self.most_steps * candidates * episodes


def task_of(env: Any) -> dict[str, Any]:
    """What agents are for: the observations, the action space, and what a task file declares."""
    policy = Policy(None).bind(env)
    declared = env.task.document if hasattr(env, "task") else {}
    return {"observations": policy.names, "actions": str(policy.space), **declared}
