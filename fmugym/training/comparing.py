"""Comparison of agents over episodes that no search has seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from fmugym.baselines.candidate_evaluation import CandidateEvaluator, CandidateScores
from fmugym.episodes.evaluation import HELD_OUT_SEED
from fmugym.search.policy import ResidualAgent
from fmugym.series.intervals import confidence

__all__ = ["judge", "verdict"]


def judge(
    agents: Mapping[str, ResidualAgent],
    evaluators: Mapping[str, CandidateEvaluator],
    episodes: int,
    leave_out: Callable[[str, Exception], None],
    advance: Callable[[str, float], None] = lambda name, part: None,
) -> dict[str, Any]:
    """Let agents play the same episodes.

    Args:
        agents: By name.
        evaluators: Evaluators of the scenarios, by name; they are closed.
        episodes: How many episodes of each scenario.
        leave_out: Is told of an agent that cannot play to the end, or of a scenario that cannot be
            opened, by name and with the reason. The others play all the same.
        advance: Is told which part of all its episodes an agent has played since the last call.

    Returns:
        By the names of the agents, in types that JSON has: ``total_reward``, the mean of an
        episode summed over the scenarios; ``rewards`` of the episodes by scenario; and
        ``mean_costs`` by name, with the part of ``failed episodes``, which a fault has cut short.
    """
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + episodes)
    played: dict[str, list[CandidateScores]] = {name: [] for name in agents}
    opened = []
    for scenario, evaluator in evaluators.items():
        with closing(evaluator):
            try:
                evaluator.open(len(seeds))
            except Exception as error:
                leave_out(f"scenario {scenario}" if len(evaluators) > 1 else scenario, error)
                continue
            opened.append(scenario)
            for name in list(played):
                evaluator.advance = lambda part, name=name: advance(name, part / len(evaluators))  # type: ignore[misc]
                try:
                    played[name].append(agents[name].play(evaluator, seeds))
                except Exception as error:
                    leave_out(name, error)
                    del played[name]
                    evaluator.close()  # its episodes are in the middle of something
    return _told(played if opened else {}, opened)


def _told(
    played: Mapping[str, Sequence[CandidateScores]], scenarios: Sequence[str]
) -> dict[str, Any]:
    test = {}
    for name, outcomes in played.items():
        costs = np.mean([one.costs for one in outcomes], axis=(0, 1, 2)).tolist()
        rewards = (one.returns[0].tolist() for one in outcomes)
        test[name] = {
            "total_reward": sum(float(one.returns.mean()) for one in outcomes),
            "rewards": dict(zip(scenarios, rewards, strict=True)),
            "mean_costs": dict(zip((*outcomes[0].limits, "failed episodes"), costs, strict=True)),
        }
    return test


def verdict(test: Mapping[str, Any], limits: Mapping[str, float]) -> str:
    """Describe the result in a line: the first agent beside the second one.

    Args:
        test: Result of ``judge``.
        limits: Limits of the costs of an episode, by name.
    """
    first, *others = test
    text = ", ".join(f"{name} {one['total_reward']:.6g}" for name, one in test.items())
    text += f": {_beside(test, first, others[0])}" if others else ""
    for cost, limit in limits.items():
        both = [f"{name} {test[name]['mean_costs'][cost]:.4g}" for name in [*test][:2]]
        text += f"; {cost} {', '.join(both)} of at most {limit:g}"
    return text


def _beside(test: Mapping[str, Any], name: str, other: str) -> str:
    """Compare an agent with another one, in per cent only for totals of one sign and magnitude.

    The interval is that of the differences in each episode, beside their mean in the scenario.
    """
    one, two = test[name], test[other]
    base = two["total_reward"]
    gain = one["total_reward"] - base
    half = confidence(
        *(np.subtract(own, two["rewards"][key]).tolist() for key, own in one["rewards"].items())
    )
    is_relative = base * (base + gain) > 0 and abs(gain) < 10 * abs(base)
    scale, unit = (100 / abs(base), " %") if is_relative else (1.0, "")
    size, word = scale * abs(gain), "better" if gain >= 0 else "worse"
    text = f"{size:.3g}{unit} {word} than {other}"
    if half:
        half *= scale
        text += f" ({size - half:.3g} to {size + half:.3g})"
        text += ", which may be chance," if half >= size else ""
    return text + " in unseen episodes" * (half is not None)
