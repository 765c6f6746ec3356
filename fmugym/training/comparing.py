"""Who has won: agents play episodes that no search has seen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from fmugym.baselines.arena import Arena, Outcome
from fmugym.episodes.evaluation import HELD_OUT_SEED
from fmugym.search.agent import Agent
from fmugym.series.intervals import student

__all__ = ["Verdict", "episodes_of", "judge"]

_EPISODES: Final = 100
_OF_SCENARIO: Final = 4
"""Episodes of a test, and of each scenario if the task has some."""


@dataclass(frozen=True)
class Verdict:
    """What agents have reached; all have played the same episodes.

    Attributes:
        outcomes: By name, what each has reached in the episodes of each scenario. The first one is
            judged beside the second one.
        scenarios: The names of the scenarios.
        limits: What each cost may add up to in an episode, by name.
    """

    outcomes: Mapping[str, Sequence[Outcome]]
    scenarios: Sequence[str]
    limits: Mapping[str, float]

    def total(self, name: str) -> float:
        """The mean return of an agent, summed over the scenarios."""
        return sum(float(one.returns.mean()) for one in self.outcomes[name])

    def gain(self, name: str, other: str) -> tuple[float, float]:
        """How much more one agent has reached than another one.

        Returns:
            The difference of the totals, and half the width of its 95 % confidence interval; that
            is NaN if there is one episode only. The interval comes from the differences in each
            episode beside their mean in the scenario.
        """
        pairs = zip(self.outcomes[name], self.outcomes[other], strict=True)
        each = [(one.returns - two.returns).ravel() for one, two in pairs]
        gain = sum(float(values.mean()) for values in each)
        freedom = sum(len(values) - 1 for values in each)
        if not freedom:
            return gain, math.nan
        variance = sum(float(values.var(ddof=1)) / len(values) for values in each)
        return gain, student(freedom) * math.sqrt(variance)

    def text(self) -> str:
        """The verdict in a line: who has won, and the costs of the first two beside limits."""
        told = self.as_dict()
        first, *others = told
        text = ", ".join(f"{name} {one['total_reward']:.6g}" for name, one in told.items())
        text += f": {self._beside(first, others[0])}" if others else ""
        for cost, limit in self.limits.items():
            both = [f"{name} {told[name]['mean_costs'][cost]:.4g}" for name in [*told][:2]]
            text += f"; {cost} {', '.join(both)} of at most {limit:g}"
        return text

    def _beside(self, name: str, other: str) -> str:
        """One agent beside another one; per cent only of totals of one sign and one magnitude."""
        gain, half = self.gain(name, other)
        base, unit = self.total(other), ""
        if base * self.total(name) > 0 and abs(gain) < 10 * abs(base):
            gain, half, unit = 100 * gain / abs(base), 100 * half / abs(base), " %"
        word = "better" if gain >= 0 else "worse"
        interval = ""
        if math.isfinite(half):
            interval = f" ({abs(gain) - half:.3g} to {abs(gain) + half:.3g})"
        doubt = ", which may be chance," if half >= abs(gain) else ""
        return f"{abs(gain):.3g}{unit} {word} than {other}{interval}{doubt} in unseen episodes"

    def as_dict(self) -> dict[str, Any]:
        """The numbers in types that JSON has."""
        return {
            name: {
                "total_reward": self.total(name),
                "rewards": {
                    scenario: one.returns.ravel().tolist()
                    for scenario, one in zip(self.scenarios, outcomes, strict=True)
                },
                "mean_costs": {
                    cost: float(np.mean([one.costs[..., index].mean() for one in outcomes]))
                    for index, cost in enumerate(self.limits)
                },
            }
            for name, outcomes in self.outcomes.items()
        }


def episodes_of(scenarios: int, episodes: int | None) -> int:
    """How many episodes of each scenario are played.

    Args:
        scenarios: How many there are.
        episodes: What the user says; None for the default.
    """
    return episodes or (_EPISODES if scenarios < 2 else _OF_SCENARIO)


def judge(
    agents: Mapping[str, Agent],
    arenas: Mapping[str, Arena],
    limits: Mapping[str, float],
    episodes: int | None,
) -> Verdict:
    """Let agents play.

    Args:
        agents: By name.
        arenas: Those of the scenarios, by name; they are closed.
        limits: What each cost may add up to in an episode, by name.
        episodes: How many episodes of each scenario; None for the default.
    """
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + episodes_of(len(arenas), episodes))
    outcomes: dict[str, list[Outcome]] = {name: [] for name in agents}
    for arena in arenas.values():
        with closing(arena):
            for name, agent in agents.items():
                outcomes[name].append(agent.play(arena, seeds))
    return Verdict(outcomes, list(arenas), limits)
