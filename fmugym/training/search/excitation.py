"""Excitation of an FMU: disturbed actions for the identification of a surrogate."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any, Final, Self

import numpy as np
from gymnasium import spaces

from fmugym.control.candidate_evaluation import CandidateEvaluator
from fmugym.control.controller import Controller
from fmugym.control.controller_parsing import has_range, search_of
from fmugym.control.surrogate.recorded_trajectories import EpisodeTrajectory, Trajectories
from fmugym.control.surrogate.surrogate import Surrogate
from fmugym.control.surrogate.surrogate_fit import fit
from fmugym.pool.pool import FloatArray
from fmugym.pool.states import IndexArray
from fmugym.training.search.policy import ResidualAgent, ResidualPolicy, choices_of
from fmugym.training.search.probe import Probe

__all__ = ["Excitation", "excite", "fitted_surrogate"]

_RANDOM: Final = 0.4
"""Share of segments with a random action."""

_SHIFTED: Final = 0.3
"""Share of segments in which the action of the controller is shifted."""

_AT_AN_END: Final = 0.3
"""Share of random actions that are an end of their range."""

_SHIFT: Final = 0.3
"""Largest shift, as a part of the range."""

_SEEDS: Final = 500_000
"""Upper bound of the seeds; seeds of validations are larger."""

_LONGEST: Final = 16
"""Longest segment, in steps; short segments are as frequent as long ones."""


_STARTS: Final = 32
"""Number of starts without a step, which show the outputs at the beginning of episodes."""

_GROUP: Final = 8
_OF_PROBE: Final = 20
"""One step of so many is for the probe of a task."""

_OF_TEST: Final = 4
"""One step of so many, at most, is for the step test that suggests controllers."""

_EPISODES: Final = 8
"""Number of episodes among which steps are divided; more if these are shorter."""


def fitted_surrogate(
    make_env: Callable[[], Any], steps: int, seed: int = 0, unseen: int = 0
) -> tuple[Surrogate, list[EpisodeTrajectory]]:
    """Excite an FMU, and fit a surrogate to the trajectories.

    Args:
        make_env: Makes the environment, in the physical form of its task.
        steps: The steps of the FMU, at most.
        seed: Seed of episodes and actions.
        unseen: How many more episodes are played afterwards, for a test. Their steps do not count.

    Returns:
        The surrogate, and the trajectories of these episodes.

    Raises:
        ConfigError: If no policy can be searched for the task, or its first step always fails.
    """
    trajectories, rng = Trajectories(), np.random.default_rng(seed)
    most = max(_GROUP, steps // _OF_PROBE)
    probe = Probe.of(
        make_env,
        _GROUP,
        lambda line: None,
        most_tested=steps // _OF_TEST,
        most=most,
        backend=trajectories,
    )
    length = max(1, min(probe.most_steps, (steps - trajectories.steps) // _EPISODES))
    with closing(CandidateEvaluator(make_env, _GROUP, length, backend=trajectories)) as evaluator:
        excite(evaluator, trajectories, probe, (steps - trajectories.steps) // length, rng)
        found, known = fit(trajectories), len(trajectories.all())
        if unseen:
            evaluator.most_steps = probe.most_steps
            excite(evaluator, trajectories, probe, unseen, rng)
    return found, [one for one in trajectories.all()[known:] if one.steps]


def excite(
    evaluator: CandidateEvaluator,
    trajectories: Trajectories,
    probe: Probe,
    count: int,
    rng: np.random.Generator,
) -> None:
    """Play episodes with the untuned controllers of a task, whose actions are disturbed.

    Args:
        evaluator: Its episodes are no longer than they shall be; its backend are the trajectories.
        trajectories: Keep what the FMU does.
        probe: Probe of the task.
        count: How many episodes there are.
        rng: Draws episodes and actions.
    """
    seeds = [0] * count if probe.is_same else rng.integers(_SEEDS, size=count).tolist()
    for place, agent in enumerate(probe.agents):
        own = seeds[place :: len(probe.agents)]
        if own:
            seed = int(rng.integers(_SEEDS))
            made = partial(_excitation, evaluator, agent, seed)
            evaluator.play(made, np.zeros((1, 1)), own)
    envs = evaluator.open(1)
    starts = rng.integers(_SEEDS, size=_STARTS)
    for begin in range(0, _STARTS, envs.num_envs):
        before = trajectories.steps
        envs.reset(seed=np.resize(starts[begin:], envs.num_envs).tolist())
        if probe.is_same or trajectories.steps > before:  # warm-ups take steps, too
            return


def _excitation(
    evaluator: CandidateEvaluator, agent: ResidualAgent, seed: int, rows: FloatArray
) -> Any:
    """The excitation of the episodes that an evaluator plays next."""
    return Excitation(_untuned(agent), seed, evaluator.jobs)


def _untuned(agent: ResidualAgent) -> ResidualPolicy:
    """An agent whose numbers are in the middle of their ranges, and whose weights are 0."""
    if has_range(agent.text):
        middle = np.full(len(search_of(agent.text).ranges), 0.5)
        return agent.with_numbers(middle).policy()
    return (agent if agent.is_found else agent.with_numbers(np.zeros(agent.size))).policy()


class Excitation:
    """A controller whose actions are replaced or shifted for some steps at a time.

    Args:
        controller: The controller.
        seed: Seed of the segments.
        episodes: The number of each environment's episode among those with this seed, shape (N,),
            so that episodes do not depend on how many environments step together.
    """

    def __init__(self, controller: Controller, seed: int, episodes: IndexArray) -> None:
        self._controller, self._seed, self._episodes = controller, seed, episodes

    def bind(self, env: Any) -> Self:
        """See ``Controller.bind``."""
        self._controller.bind(env)
        space: Any = env.single_action_space
        self._shape, self._dtype = (env.num_envs, *space.shape), env.action_space.dtype
        self._is_discrete = bool(choices_of(space))
        if self._is_discrete:
            counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
            self._low = np.broadcast_to(getattr(space, "start", 0), space.shape)
            self._high = self._low + np.asarray(counts) - 1
        else:
            self._low, self._high = space.low, space.high
        numbers = np.maximum(self._episodes, 0).tolist()
        self._rngs = [np.random.default_rng([self._seed, number]) for number in numbers]
        self._left = np.zeros(self._shape, int)
        self._kind: Any = np.zeros(self._shape)
        self._value: Any = np.zeros(self._shape)
        return self

    def act(self, observation: Any, info: Any = None) -> Any:
        """See ``Controller.act``."""
        self._begin_segments(self._left <= 0)
        self._left -= 1
        base = np.asarray(self._controller.act(observation, info), np.float64)
        width = self._high - self._low
        shifted = base + self._value * width
        action = np.where(self._kind == 1, self._low + self._value * width, base)
        action = np.clip(np.where(self._kind == 2, shifted, action), self._low, self._high)
        return (np.rint(action) if self._is_discrete else action).astype(self._dtype)

    def _begin_segments(self, mask: Any) -> None:
        for place in zip(*np.nonzero(mask), strict=True):
            rng = self._rngs[place[0]]
            drawn, level, end, shift, length = rng.uniform(size=5)
            is_random, is_shifted = drawn < _RANDOM, drawn < _RANDOM + _SHIFTED
            self._kind[place] = 1 if is_random else 2 if is_shifted else 0
            level = round(level) if end < _AT_AN_END else level
            self._value[place] = level if is_random else _SHIFT * (2.0 * shift - 1.0)
            self._left[place] = int((_LONGEST + 1.0) ** length)
