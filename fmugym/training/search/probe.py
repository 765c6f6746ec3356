"""Probe of a task before a search: its length, speed, observations and first controllers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.control.candidate_evaluation import (
    MOST_STEPS,
    CandidateEvaluator,
    CandidateScores,
    most_steps_of,
)
from fmugym.control.controller_parsing import plans_ahead, simple_controllers
from fmugym.control.controller_table import acting_text, named_controllers, parts_of
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.pool.pool import FloatArray
from fmugym.task.likely_units import require_units
from fmugym.training.search.policy import ResidualAgent, ResidualPolicy, require_numbers
from fmugym.training.search.suggested_controllers import (
    MOST_TESTED,
    Loops,
    steps_of_test,
    suggested_controllers,
)

__all__ = ["FEW", "MOST_PROBED", "Probe", "agent_task"]

FEW: Final = 8
"""The candidates of a round for a controller, which has few numbers."""

_ACTIONS: Final = 2
_EPISODES: Final = 4
_STEPS: Final = 100
"""So many constant actions play so many episodes, until their ends or for so many steps."""

_QUICK: Final = 2e-3
_TRIED: Final = 2
"""Steps that measure the time of a step."""

_TIMED: Final = 25
"""If a step takes less than this in seconds, as many candidates as in a round tell its time by so
many steps: the overhead of a call is for all of them."""

MOST_PROBED: Final = _EPISODES * (_ACTIONS * (_TRIED + _STEPS) + FEW * _TIMED)
"""Most steps of a probe. All of them count, since the number that is played depends on the time."""

_TEST_BY_LOOK: Final = 5
"""The test by which controllers are guessed takes so many times the time of the look."""


@dataclass(frozen=True)
class Probe:
    """Facts about a task that a search needs.

    Attributes:
        task: See ``agent_task``.
        linear: The linear policy without a controller, whose weights are missing.
        agents: Controllers that the task declares and that do not plan ahead. Without any, those
            that suggest themselves, or else a constant action.
        limits: Limits of the costs of an episode.
        most_steps: The steps after which an episode is stopped.
        is_same: Whether all episodes are the same.
        seconds: Real time of a step of one environment among many.
        usual_steps: The steps of an episode: of the longest one, if all have ended early.
        steps: As many count for the probe.
    """

    task: Mapping[str, Any]
    linear: ResidualAgent
    agents: Sequence[ResidualAgent]
    limits: Mapping[str, float]
    most_steps: int
    is_same: bool
    seconds: float
    usual_steps: int
    steps: int = MOST_PROBED

    @classmethod
    def of(
        cls,
        make_env: Callable[[], FMUEnv],
        envs: int,
        tell: Callable[[str], None],
        most: int = MOST_PROBED,
        backend: Any = "auto",
        seconds: float = np.inf,
        most_tested: int = MOST_TESTED,
    ) -> Probe:
        """Take some steps with constant actions.

        Args:
            make_env: A function that makes the environment.
            envs: The largest number of environments.
            tell: Gets lines about what a user would not expect.
            most: The largest number of steps, without those of the test.
            backend: See ``FMUVectorEnv``.
            seconds: How long the steps may take, about; those of the test five times as long.
            most_tested: The most steps of the test by which controllers are guessed.

        Raises:
            ConfigError: If no policy can be searched for the task, or its first step always fails.
        """
        declared = _Declarations.of(make_env, tell)
        with closing(CandidateEvaluator(make_env, envs, _TRIED, backend=backend)) as evaluator:
            look = _look(evaluator, declared.linear, most, seconds)
            if seconds < np.inf:
                in_time = _TEST_BY_LOOK * seconds / max(look.seconds, 1e-9)
                most_tested = int(min(most_tested, in_time))
            guessed = _guessed(evaluator, declared.loops, tell, most_tested)
            agents = declared.agents or list(guessed) or [declared.constant]
        _warn(declared, look.scores, tell)
        most_steps = declared.length or MOST_STEPS
        tested = 0 if declared.loops is None else steps_of_test(declared.loops, most_tested)
        return cls(
            declared.task,
            declared.linear,
            agents,
            declared.limits,
            most_steps,
            is_same=not np.ptp(look.seen, axis=1).any(),
            seconds=look.seconds,
            usual_steps=look.longest if look.longest < look.steps else most_steps,
            steps=most + tested,
        )

    def round_time(self, episodes: int) -> float:
        """Estimated seconds of a round of a controller, until episodes become longer."""
        return self.seconds * self.usual_steps * FEW * episodes


@dataclass(frozen=True)
class _Declarations:
    """Declarations of a task that an environment of it has.

    Attributes:
        task: See ``agent_task``.
        linear: As in ``Probe``.
        constant: The agent of a constant action.
        agents: The controllers that the task declares, as in ``Probe``.
        loops: The loops for which controllers may be guessed, if it declares none.
        length: The most steps of an episode, if it has a length.
        limits: Limits of the costs of an episode.
    """

    task: Mapping[str, Any]
    linear: ResidualAgent
    constant: ResidualAgent
    agents: list[ResidualAgent]
    loops: Loops | None
    length: int | None
    limits: Mapping[str, float]

    @classmethod
    def of(cls, make_env: Callable[[], FMUEnv], tell: Callable[[str], None]) -> _Declarations:
        with closing(make_env()) as env:
            require_numbers(env.observation_space, env.action_space)
            policy, task = ResidualPolicy(None).bind(env), agent_task(env)
            require_units(env)
            agents = list(_declared(task, env, tell))
            return cls(
                task,
                ResidualAgent("linear", None, len(policy.names), policy.acting),
                ResidualAgent("constant action", acting=policy.acting),
                agents,
                None if agents else Loops.of(task, env),
                most_steps_of(env),
                dict(getattr(env, "cost_limits", {})),
            )


@dataclass(frozen=True)
class _Look:
    """Some episodes of constant actions.

    Attributes:
        scores: What they have reached.
        seconds: Real time of a step of one environment among many.
        longest: The steps of the longest one.
        steps: The steps after which each was stopped.
    """

    scores: CandidateScores
    seconds: float
    longest: int
    steps: int

    @property
    def seen(self) -> FloatArray:
        """Numbers that differ where episodes differ, shape (actions, episodes, k)."""
        return np.dstack([self.scores.returns, self.scores.moments])


def _look(evaluator: CandidateEvaluator, linear: ResidualAgent, most: int, seconds: float) -> _Look:
    """Take some steps with constant actions, for as long as there is time.

    Raises:
        ConfigError: If the first step always fails.
    """
    rows = linear.extended(np.random.default_rng(0).uniform(-1, 1, (FEW, linear.acting)))
    few, seeds = rows[:_ACTIONS], range(_EPISODES)
    steps = max(1, min(_STEPS, most // (_ACTIONS * _EPISODES)))
    if seconds < np.inf:
        evaluator.play(linear, few, seeds)
        needed = most * evaluator.seconds / evaluator.steps
        steps = steps if needed <= seconds else max(_TRIED, int(steps * seconds / needed))
    evaluator.count_anew(steps)
    scores = evaluator.play(linear, few, seeds, has_moments=True)
    if evaluator.steps == scores.costs[..., -1].sum():
        raise ConfigError(
            f"the first step fails, whatever the action: {evaluator.infos['fault'][0]}; "
            "'fmugym validate' tells more"
        )
    is_quick = evaluator.seconds < _QUICK * evaluator.steps
    if most == MOST_PROBED and steps == _STEPS and is_quick:
        evaluator.count_anew(_TIMED)
        evaluator.play(linear, rows, seeds)
    return _Look(scores, evaluator.seconds / evaluator.steps, evaluator.longest, steps)


def _warn(declared: _Declarations, scores: CandidateScores, tell: Callable[[str], None]) -> None:
    """Tell of rewards that no action changes, and of episodes without a length."""
    if np.ptp(scores.returns) == 0:
        tell(
            f"warning: all episodes have reached {scores.returns[0, 0]:g}, whatever the "
            "actions: what is to be learned?"
        )
    if declared.length is None:
        tell(f"warning: episodes have no length; they are stopped after {MOST_STEPS} steps")


def _declared(
    task: Mapping[str, Any], env: Any, tell: Callable[[str], None]
) -> Iterator[ResidualAgent]:
    """The controllers that a task declares, that do not plan ahead and that fit its actions."""
    given = task.get("controllers", {})
    for name, one in named_controllers(given).items():
        if plans_ahead(one):
            continue
        agent = ResidualAgent(name, acting_text(one))
        try:
            (controller,) = simple_controllers({name: agent.text})
            controller.bind(env)
        except ConfigError as error:
            if name not in parts_of(given):
                tell(f"left out: {name}: {error}")
        else:
            yield agent


def _guessed(
    evaluator: CandidateEvaluator,
    loops: Loops | None,
    tell: Callable[[str], None],
    most_tested: int,
) -> Iterator[ResidualAgent]:
    """Controllers that a step test suggests for some loops."""
    if loops is None:
        return
    try:
        guesses = suggested_controllers(evaluator, loops, most_tested)
    except ConfigError as error:
        tell(f"no controller is guessed: {error}")
    else:
        yield from (ResidualAgent(name, text) for name, text in guesses.items())


def agent_task(env: Any) -> dict[str, Any]:
    """Identity of an agent's task: observations, action space, and the declarations of its file."""
    policy = ResidualPolicy(None).bind(env)
    declared = env.task.document if hasattr(env, "task") else {}
    return {"observations": policy.names, "actions": str(policy.space), **declared}
