"""Search on a surrogate of an FMU, with its results proved on the FMU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from time import monotonic
from typing import Final, NamedTuple

from fmugym.control.candidate_evaluation import CandidateEvaluator, CandidateScores, Merit
from fmugym.control.surrogate.recorded_trajectories import Trajectories
from fmugym.control.surrogate.surrogate import Surrogate
from fmugym.control.surrogate.surrogate_fit import fit
from fmugym.errors import ConfigError
from fmugym.training.search.excitation import excite
from fmugym.training.search.policy import ResidualAgent
from fmugym.training.search.policy_search import VALIDATION, Search

__all__ = ["TwinSearch"]

_PROVED: Final = VALIDATION + 2000
"""The first seed of the episodes in which the FMU is compared with its surrogate."""

_TOLD: Final = VALIDATION + 3000
_PREDICTED: Final = 32
"""First seed and number of the episodes that the surrogate plays for a prediction."""

_EXCITED: Final = 0.4
"""The part of all steps that excite the FMU,"""

_FEWEST: Final = 4
"""in at least so many episodes."""

_FEWEST_PLAYED: Final = 6
"""Least number of episodes for the steps: the exciting ones, one of the tuned controller and one of
a policy."""

_DIVIDED: Final = 16
"""From so many episodes on, they are as long as the task's."""

_CYCLES: Final = 5
_FIRST: Final = 300
_MORE: Final = 80
"""Rounds of the search until the first proof, and from one proof to the next."""

_CLOSE: Final = 0.2
"""Tolerated error of a prediction, as a part of the gain."""

_MANY: Final = 256
"""So many surrogates step together."""


class Proof(NamedTuple):
    """Result of an agent on the FMU.

    Attributes:
        agent: The agent.
        seeds: Seeds of its episodes.
        measured: Its result there.
    """

    agent: ResidualAgent
    seeds: Sequence[int]
    measured: CandidateScores


class Standing(NamedTuple):
    """Estimate of an agent's merit, with the surrogate's predictions of its episodes."""

    merit: Merit
    predicted: float
    measured: float


@dataclass
class TwinSearch:
    """A search on a surrogate of an FMU, whose result is proved on the FMU.

    The FMU is excited; a surrogate is fitted to what it does; a search plays on the surrogate; and
    the best agents play on the FMU, from which the next surrogate learns, too. An agent counts as
    the surrogate says, corrected by what the FMU gives more in the same few episodes.

    Attributes:
        found: The search.
        evaluator: The FMU's; its trajectories are kept.
        trajectories: Trajectories of the FMU.
        steps: How many steps of the FMU there may be.
        seconds: The real time that is left.
        rounds: The largest number of rounds.
        tell: Gets lines of text.
        advance: Is told after each round of the seconds since the last one, and of the scores.
        best: The best agent that the FMU has played until now; None before the first one.
    """

    found: Search
    evaluator: CandidateEvaluator
    trajectories: Trajectories
    steps: float
    seconds: float
    rounds: float
    tell: Callable[[str], None]
    advance: Callable[[float, str], None]
    proofs: list[Proof] = field(default_factory=list)
    best: ResidualAgent | None = None

    def __post_init__(self) -> None:
        self._end = monotonic() + self.seconds
        most, left = self.found.probe.most_steps, self.steps - self.evaluator.steps
        self.length = int(min(most, max(left // _DIVIDED, min(most / 2, left // _FEWEST_PLAYED))))
        self.evaluator.most_steps = self.length

    def winner(self) -> ResidualAgent:
        """The best agent.

        Raises:
            ConfigError: If nothing was found.
        """
        if self.length < 1:
            raise ConfigError(
                f"{self.found.rounds} rounds are too few to find anything, and there are no steps "
                "for a surrogate: give more --minutes or --steps"
            )
        count = max(_FEWEST, round(_EXCITED * self.steps / self.length))
        excite(self.evaluator, self.trajectories, self.found.probe, count, self.found.rng)
        for cycle in range(_CYCLES):
            surrogate = self._fitted()
            with closing(self._evaluator_on(surrogate)) as twin:
                if cycle:
                    self.found.revalidate(twin)
                self._search(twin, cycle)
                self._prove()
                values = self._values(twin)
            if not values:
                raise ConfigError(
                    f"{self.found.rounds} rounds on a surrogate are too few to find anything: give "
                    "more --minutes"
                )
            self._tell_of(values)
            best = max(range(len(values)), key=lambda place: values[place].merit)
            winner = self.best = self.proofs[best].agent
            is_over = self._left < 1 or monotonic() > self._end or self.found.rounds >= self.rounds
            if is_over or _is_close(values, best):
                break
        return winner

    # The search on the surrogate.

    def _fitted(self) -> Surrogate:
        found = fit(self.trajectories)
        self.tell(
            f"surrogate of {self.evaluator.steps} steps: {found.terms.form}; errors of "
            f"simulations are {100 * found.error:.2g} % of the variation of outputs"
        )
        return found

    def _evaluator_on(self, surrogate: Surrogate) -> CandidateEvaluator:
        """Evaluator on the surrogate, of whole episodes."""
        probe = self.found.probe
        return CandidateEvaluator(
            self.evaluator.make_env, _MANY, probe.most_steps, probe.limits, backend=surrogate
        )

    def _search(self, twin: CandidateEvaluator, cycle: int) -> None:
        found, left = self.found, self._end - monotonic()
        until = monotonic() + left / 2
        last = min(self.rounds, found.rounds + (_MORE if cycle else _FIRST))
        while found.rounds < last and not found.is_over and monotonic() < until:
            begin = monotonic()
            found.advance(twin)
            self.advance(monotonic() - begin, f"round {found.rounds} on the surrogate")

    # The proof on the FMU.

    @property
    def _episodes(self) -> int:
        """Number of episodes of the FMU that prove an agent."""
        return (
            2 if self.length == self.found.probe.most_steps and not self.found.probe.is_same else 1
        )

    @property
    def _left(self) -> int:
        """Number of agents that the rest of the steps can prove."""
        return int((self.steps - self.evaluator.steps) // (self.length * self._episodes))

    def _prove(self) -> None:
        """Let the baseline and the best policies play on the FMU."""
        found = self.found
        ranked = sorted(found.policies, key=lambda one: one.merit, reverse=True)
        proved = [one.agent for one in self.proofs]
        best = [one.best for one in ranked if one.best]
        agents = [one for one in best[:2] if not any(one is other for other in proved)]
        base = found.baseline or found.ahead
        if not self.proofs and base.best:
            agents.insert(0, base.best)
        for agent in agents[: self._left]:
            seeds = range(_PROVED, _PROVED + self._episodes)
            self.proofs.append(Proof(agent, seeds, agent.play(self.evaluator, seeds)))

    def _values(self, twin: CandidateEvaluator) -> list[Standing]:
        """Merits of the agents that have played on the FMU."""
        return [self._value(one, twin) for one in self.proofs]

    def _value(self, proof: Proof, twin: CandidateEvaluator) -> Standing:
        most = twin.most_steps
        twin.most_steps = self.length
        same = proof.agent.play(twin, proof.seeds)
        twin.most_steps = most
        count, times = 1 if self.found.probe.is_same else _PREDICTED, most / self.length
        many = proof.agent.play(twin, range(_TOLD, _TOLD + count))
        wrong = proof.measured.returns - same.returns, proof.measured.costs - same.costs
        corrected = many._replace(
            returns=many.returns + times * wrong[0].mean(),
            costs=many.costs + times * wrong[1].mean(axis=1, keepdims=True),
        )
        measured, predicted = (float(one.returns.mean()) for one in (proof.measured, same))
        return Standing(corrected.merits[0], predicted, measured)

    def _tell_of(self, values: Sequence[Standing]) -> None:
        """Report the predictions of the surrogate, and the results on the FMU."""
        for proof, value in zip(self.proofs, values, strict=True):
            self.tell(
                f"{proof.agent.name}: predicted {value.predicted:.5g}, measured "
                f"{value.measured:.5g} in {len(proof.seeds)} episodes of {self.length} steps"
            )


def _is_close(values: Sequence[Standing], best: int) -> bool:
    """Whether the errors of the surrogate are small compared with the gain."""
    wrong = abs(values[best].predicted - values[best].measured)
    return wrong <= _CLOSE * abs(values[best].merit[1] - values[0].merit[1])
