"""Evaluation of candidates: many controllers play the same episodes in one vector environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from time import perf_counter
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.control.controller import Controller
from fmugym.environment.env import FMUEnv
from fmugym.environment.vector import FMUVectorEnv
from fmugym.errors import FMUGymError
from fmugym.pool.machine_limits import available_processors
from fmugym.pool.pool import FloatArray
from fmugym.pool.states import IndexArray

__all__ = [
    "MOST_ENVS",
    "MOST_STEPS",
    "CandidateEvaluator",
    "CandidateScores",
    "CeilingError",
    "Merit",
    "most_steps_of",
]

MOST_ENVS: Final = 256
"""As many environments step together, unless the caller says less: more would hardly be faster."""

MOST_STEPS: Final = 10_000
"""Steps after which an episode without an end is stopped."""

Merit = tuple[float, float]
"""Merit of a candidate: minus the excess of its costs, and its mean return. More is better."""


def most_steps_of(env: FMUEnv) -> int | None:
    """The limit of steps of an episode, by the config or the registered id; None for no limit."""
    return env.config.max_episode_steps or getattr(env.spec, "max_episode_steps", None)


class CeilingError(FMUGymError):
    """The evaluation may not take more steps."""


class CandidateScores(NamedTuple):
    """Returns and costs of n candidates in k episodes.

    Attributes:
        returns: The total rewards, shape (n, k).
        costs: The total of each cost that has a limit, and 1 for an episode that a fault has cut
            short, shape (n, k, c + 1).
        limits: The limits by name.
        moments: The totals of ``moments`` of the controllers, shape (n, k, r); r is 0 if nobody
            has asked for them.
    """

    returns: FloatArray
    costs: FloatArray
    limits: Mapping[str, float]
    moments: FloatArray

    @property
    def merits(self) -> list[Merit]:
        """Merit of each candidate; candidates within all cost limits come first.

        A fault is an excess, too, as its episode has less to pay for. NaN is an infinite one.
        """
        bounds = np.array([*self.limits.values(), 0.0])
        sizes = np.where(bounds == 0.0, 1.0, np.abs(bounds))
        beyond = np.maximum(self.costs.mean(axis=1) - bounds, 0.0) / sizes
        returns = self.returns.mean(axis=1)
        excess = np.nan_to_num(beyond.sum(axis=1) + 0 * returns, nan=np.inf)
        return list(zip((-excess).tolist(), returns.tolist(), strict=True))

    @property
    def order(self) -> list[int]:
        """The candidates by their merits, the best one first."""
        merits = self.merits
        return sorted(range(len(merits)), key=merits.__getitem__, reverse=True)


@dataclass
class CandidateEvaluator:
    """A vector environment in which candidates play the same episodes.

    The environments are made when they are needed, and again when more of them are. Where
    candidates and episodes are too many for them, they play in groups, with the same result. Where
    they are too few, the other environments rest. FMUs that call Python step in worker processes,
    unless the config says otherwise.

    Attributes:
        make_env: A function that makes the environment, or its class.
        most_envs: The largest number of environments.
        most_steps: Steps after which an episode is stopped.
        limits: Limits of the costs of an episode, by name.
        steps: The steps of all episodes until now.
        seconds: The real time that they have taken.
        ceiling: The largest number of steps.
        longest: The steps of the longest episode until now.
        infos: Infos of the last step.
        jobs: Which job each environment plays, shape (N,), before ``play`` makes a controller; -1
            for none. Job ``i * k + j`` is episode j of k of candidate i.
        advance: Is told of each step, as a part of all that ``play`` has to do.
        backend: Backend in the place of the FMU; see ``FMUVectorEnv``.
    """

    make_env: Callable[[], Any]
    most_envs: int = MOST_ENVS
    most_steps: int = MOST_STEPS
    limits: Mapping[str, float] = field(default_factory=dict)
    steps: int = 0
    longest: int = 0
    seconds: float = 0.0
    ceiling: float = np.inf
    infos: Any = None
    jobs: IndexArray = field(default_factory=lambda: np.zeros(0, np.int64))
    advance: Callable[[float], None] = lambda part: None
    backend: Any = "auto"
    _envs: FMUVectorEnv | None = None

    def close(self) -> None:
        """Close the environments."""
        if self._envs is not None:
            self._envs.close()
            self._envs = None

    def play(
        self,
        make: Callable[[FloatArray], Controller],
        numbers: FloatArray,
        seeds: Sequence[int],
        has_moments: bool = False,
    ) -> CandidateScores:
        """Let candidates play.

        Args:
            make: Makes one controller for N environments, from the numbers of each of them, shape
                (N, k).
            numbers: Numbers of the candidates, shape (n, k).
            seeds: The seeds of their episodes.
            has_moments: Whether to add up ``moments`` of controllers, which they have after each
                decision, shape (r, N).

        Raises:
            CeilingError: If more steps are needed than there may be.
        """
        jobs = np.arange(len(numbers) * len(seeds))
        envs, groups = self.open(len(jobs)), []
        self._part = 1 / -(-len(jobs) // envs.num_envs)  # of a group
        for part in np.split(jobs, range(envs.num_envs, len(jobs), envs.num_envs)):
            # Places are spread, since neighbours step in the same thread or process.
            places = np.arange(len(part)) * envs.num_envs // len(part)
            self.jobs = np.full(envs.num_envs, -1)
            self.jobs[places] = part
            who, which = np.divmod(np.maximum(self.jobs, 0), len(seeds))
            controller = make(numbers[who]).bind(envs)
            begin, own = perf_counter(), np.array(seeds)[which].tolist()
            totals = self._play(envs, controller, own, has_moments)
            self.seconds += perf_counter() - begin
            groups.append(totals[:, places])
        totals = np.concatenate(groups, axis=1).reshape(-1, len(numbers), len(seeds))
        costs, moments = np.split(np.moveaxis(totals[1:], 0, -1), [len(self.limits) + 1], axis=-1)
        return CandidateScores(totals[0], costs, self.limits, moments)

    def count_anew(self, most_steps: int) -> None:
        """Count steps and seconds from 0, of episodes of at most so many steps."""
        self.most_steps, self.steps, self.seconds = most_steps, 0, 0.0

    def open(self, jobs: int) -> FMUVectorEnv:
        """Make the environments for so many episodes, unless there are enough.

        Raises:
            ConfigError, FMULoadError, SimulationError: If they cannot be made.
        """
        size = min(jobs, self.most_envs)
        if self._envs is None or self._envs.num_envs < size:
            self.close()
            options = self._options if size > 1 else {}
            self._envs = FMUVectorEnv(self.make_env, size, backend=self.backend, **options)
        return self._envs

    @cached_property
    def _options(self) -> dict[str, Any]:
        """Worker processes for an FMU that calls Python, which one process steps one by one."""
        with closing(self.make_env()) as env:
            is_free = env.given_backend is None and env.given_isolation is None
            apart = is_free and env.config.isolation is None and env.fmu.calls_python()
        return {"isolation": "process"} if apart and available_processors() > 1 else {}

    def _play(
        self,
        envs: FMUVectorEnv,
        controller: Any,
        seeds: list[int],
        has_moments: bool,
    ) -> FloatArray:
        """Rewards, costs, faults and moments, summed over an episode, shape (2 + c + r, N).

        Environments without a job rest, as do those whose episodes have ended.
        """
        running = self.jobs >= 0
        is_first = not envs.episodes.is_ready
        options = None if is_first or running.all() else {"reset_mask": running.copy()}
        observations, infos = envs.reset(seed=seeds, options=options)
        totals: FloatArray = np.zeros(())
        limit = min(self.most_steps, most_steps_of(envs.prototype) or MOST_STEPS)
        left = self._part
        for step in range(self.most_steps):
            count = int(np.count_nonzero(running))
            if not count:
                break
            if self.steps + count > self.ceiling:
                raise CeilingError(f"{self.ceiling:g} steps are too few: give more")
            self.steps += count
            self.longest = max(self.longest, step + 1)
            actions = controller.act(observations, infos)
            observations, rewards, terminated, truncated, infos = (
                envs.step(actions) if count == len(seeds) else envs.step_around(actions, ~running)
            )
            self.infos = infos
            values = (
                rewards,
                *(infos["costs"][name] for name in self.limits),
                truncated & infos.get("_fault", False),
                *(controller.moments if has_moments else ()),
            )
            totals = totals + np.where(running, np.stack(values), 0.0)
            running &= ~(terminated | truncated)
            left -= self._part / limit
            self.advance(self._part / limit)
        self.advance(max(left, 0.0))
        return totals
