"""Many controllers play the same episodes, side by side in one vector environment."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.baselines.controller import Controller, FloatArray
from fmugym.errors import FMUGymError
from fmugym.vector import FMUVectorEnv

__all__ = ["MOST_ENVS", "MOST_STEPS", "Arena", "CeilingError", "Outcome"]

MOST_ENVS: Final = 512
"""As many environments there are, unless the caller says less."""

_WIDEST: Final = 256
"""More environments than this need not step together: they would hardly be faster."""

MOST_STEPS: Final = 10_000
"""Steps after which an episode without an end is stopped."""

Make = Callable[[FloatArray], Controller]
"""Makes one controller for N environments, from the numbers of each of them, shape (N, k)."""


class CeilingError(FMUGymError):
    """An arena may not take more steps."""


class Outcome(NamedTuple):
    """What n candidates have reached in k episodes.

    Attributes:
        returns: The total rewards, shape (n, k).
        costs: The total of each cost that the arena watches, shape (n, k, c).
        watched: The totals of other numbers, shape (n, k, r).
    """

    returns: FloatArray
    costs: FloatArray
    watched: FloatArray


class Arena:
    """A vector environment in which candidates play the same episodes.

    The environments are made when they are needed, and kept by their number. Where candidates and
    episodes are too many for them, they play in groups, with the same result.

    Args:
        make_env: A function that makes the environment, or its class.
        most_envs: The largest number of environments, of all sizes together.
        most_steps: Steps after which an episode is stopped.
        costs: The names of costs to add up.

    Attributes:
        steps: The steps of all episodes until now.
        seconds: The real time that they have taken.
        ceiling: The largest number of steps.
    """

    def __init__(
        self,
        make_env: Callable[[], Any],
        most_envs: int = MOST_ENVS,
        most_steps: int = MOST_STEPS,
        costs: Sequence[str] = (),
    ) -> None:
        self._make_env, self._most_envs, self._most_steps = make_env, most_envs, most_steps
        self._costs = tuple(costs)
        self._envs: dict[int, FMUVectorEnv] = {}
        self.steps, self.seconds, self.ceiling = 0, 0.0, math.inf

    def close(self) -> None:
        """Close the environments."""
        while self._envs:
            _, envs = self._envs.popitem()
            envs.close()

    def play(
        self,
        make: Make,
        numbers: FloatArray,
        seeds: Sequence[int],
        watch: Callable[[Any], FloatArray] | None = None,
    ) -> Outcome:
        """Let candidates play.

        Args:
            make: Makes the controller of a group.
            numbers: What the candidates differ in, shape (n, k).
            seeds: The seeds of their episodes.
            watch: Gives more numbers of a controller that has decided, shape (r, N).

        Raises:
            CeilingError: If more steps are needed than there may be.
        """
        jobs = np.arange(len(numbers) * len(seeds))
        envs = self._opened(len(jobs))
        groups = []
        for part in np.split(jobs, range(envs.num_envs, len(jobs), envs.num_envs)):
            who, which = np.divmod(np.resize(part, envs.num_envs), len(seeds))
            controller = make(numbers[who]).bind(envs)
            own = [seeds[index] for index in which.tolist()]
            begin = perf_counter()
            totals = self._play(envs, controller, own, len(part), watch)
            self.seconds += perf_counter() - begin
            groups.append(totals[:, : len(part)])
        totals = np.concatenate(groups, axis=1).reshape(-1, len(numbers), len(seeds))
        costs, watched = np.split(np.moveaxis(totals[1:], 0, -1), [len(self._costs)], axis=-1)
        return Outcome(totals[0], costs, watched)

    def _opened(self, jobs: int) -> FMUVectorEnv:
        """Environments for so many episodes, or as many as there may be."""
        size = min(jobs, self._most_envs, _WIDEST)
        fitting = [count for count in self._envs if count >= size]
        is_full = sum(self._envs) + size > self._most_envs
        if fitting and (is_full or size in fitting):
            return self._envs[min(fitting)]
        if is_full:
            self.close()
        self._envs[size] = FMUVectorEnv(self._make_env, size)
        return self._envs[size]

    def _play(
        self, envs: FMUVectorEnv, controller: Controller, seeds: list[int], count: int, watch: Any
    ) -> FloatArray:
        """Rewards, costs and what is watched, summed over an episode, shape (1 + c + r, N).

        Environments from ``count`` on rest, as do those whose episodes have ended.
        """
        observations, infos = envs.reset(seed=seeds)
        totals: FloatArray = np.zeros((1 + len(self._costs), len(seeds)))
        watched: FloatArray = np.empty((0, len(seeds)))
        running = np.arange(len(seeds)) < count
        for _ in range(self._most_steps):
            if self.steps + count > self.ceiling:
                raise CeilingError(f"all {self.ceiling:g} steps are done")
            self.steps += count
            actions = controller.act(observations, infos)
            are_all = count == len(seeds)
            result = envs.step(actions) if are_all else envs.step_around(actions, ~running)
            observations, rewards, terminated, truncated, infos = result
            counted: Any = are_all or running  # for all, that takes less time
            costs = (infos["costs"][name] for name in self._costs)
            for total, values in zip(totals, (rewards, *costs), strict=True):
                np.add(total, values, out=total, where=counted)
            if watch is not None:
                seen = watch(controller)
                watched = watched if len(watched) else np.zeros(seen.shape)
                np.add(watched, seen, out=watched, where=counted)
            ended = terminated | truncated
            if ended.any():
                running = running & ~ended
                count = int(np.count_nonzero(running))
                if not count:
                    break
        return np.concatenate([totals, watched])
