"""A search on a surrogate of an FMU, whose result is proved on the FMU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from time import monotonic
from typing import Final, NamedTuple

import numpy as np

from fmugym.baselines.arena import Arena, Merit, Outcome
from fmugym.baselines.controller import FloatArray
from fmugym.baselines.parsing import has_range, search_of
from fmugym.search.excitation import Excitation
from fmugym.search.policy import Agent, Policy
from fmugym.search.search import VALIDATION, Search
from fmugym.surrogate.courses import Courses
from fmugym.surrogate.surrogate import Surrogate
from fmugym.surrogate.surrogate_fit import fit

__all__ = ["TwinSearch"]

_PROVED: Final = VALIDATION + 2000
"""The first seed of the episodes in which the FMU is compared with its surrogate."""

_TOLD: Final = VALIDATION + 3000
_PREDICTED: Final = 32
"""The first seed of those, and how many, that the surrogate plays for a prediction."""

_EXCITED: Final = 0.4
"""The part of all steps that excite the FMU,"""

_FEWEST: Final = 4
"""in at least so many episodes."""

_STARTS: Final = 32
"""Starts of episodes without a step, which tell how episodes begin."""

_CYCLES: Final = 5
_FIRST: Final = 120
_MORE: Final = 40
"""Rounds of the search until the first proof, and from one proof to the next."""

_CLOSE: Final = 0.2
"""A prediction is good enough if it is wrong by this part of what is gained."""

_MANY: Final = 256
"""So many surrogates step together."""


class Proof(NamedTuple):
    """What an agent has reached on the FMU.

    Attributes:
        agent: The agent.
        seeds: Those of its episodes.
        measured: What it has reached there.
    """

    agent: Agent
    seeds: Sequence[int]
    measured: Outcome


class Value(NamedTuple):
    """How good an agent is, and what the surrogate says of the episodes that it has played."""

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
        arena: The FMU's; its courses are kept.
        courses: What the FMU has done.
        steps: How many steps of the FMU there may be.
        seconds: The real time that is left.
        tell: Gets lines of text.
        advance: Is told after each round of the seconds since the last one, and of the scores.
    """

    found: Search
    arena: Arena
    courses: Courses
    steps: float
    seconds: float
    tell: Callable[[str], None]
    advance: Callable[[float, str], None]
    proofs: list[Proof] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._end = monotonic() + self.seconds
        most = self.found.probe.most_steps
        self.length = int(min(most, max(self.steps // 16, min(most / 2, self.steps // 6))))
        self.arena.most_steps = self.length

    def winner(self) -> Agent:
        """The best agent."""
        self._excite()
        for cycle in range(_CYCLES):
            surrogate = self._fitted()
            with closing(self._arena_on(surrogate)) as twin:
                if cycle:
                    self.found.revalidate(twin)
                self._search(twin, cycle)
                self._prove()
                values = self._values(twin)
            self._tell_of(values)
            best = max(range(len(values)), key=lambda place: values[place].merit)
            if self._left < 1 or monotonic() > self._end or _is_close(values, best):
                break
        return self.proofs[best].agent

    # Excitation.

    def _excite(self) -> None:
        """Play episodes with the untuned controllers, whose actions are disturbed."""
        agents, rng = self.found.probe.agents, self.found.rng
        count = max(_FEWEST, round(_EXCITED * self.steps / self.length))
        if self.found.probe.is_same:
            seeds = [0] * count
        else:
            seeds = rng.integers(VALIDATION, size=count).tolist()
        for place, agent in enumerate(agents):
            own = seeds[place :: len(agents)]
            if own:
                made = _excitations(agent, int(rng.integers(2**31)))
                self.arena.play(made, np.zeros((1, 1)), own)
        self._start_only(rng)

    def _start_only(self, rng: np.random.Generator) -> None:
        """Begin episodes without a step, unless warm-ups take steps of the FMU."""
        envs = self.arena.open(1)
        for _ in range(-(-_STARTS // envs.num_envs)):
            before = self.courses.steps
            envs.reset(seed=rng.integers(VALIDATION, size=envs.num_envs).tolist())
            if self.found.probe.is_same or self.courses.steps > before:
                return

    # The search on the surrogate.

    def _fitted(self) -> Surrogate:
        found = fit(self.courses)
        self.tell(
            f"surrogate of {self.arena.steps} steps: {found.terms.form}; simulations are wrong by "
            f"{100 * found.error:.2g} % of what outputs vary"
        )
        return found

    def _arena_on(self, surrogate: Surrogate) -> Arena:
        """Where the surrogate plays; limits are those of so many steps."""
        part = self.length / self.found.probe.most_steps
        limits = {name: part * one for name, one in self.found.probe.limits.items()}
        self.arena.limits = limits
        return Arena(self.arena.make_env, _MANY, self.length, limits, backend=surrogate)

    def _search(self, twin: Arena, cycle: int) -> None:
        found, left = self.found, self._end - monotonic()
        until = monotonic() + left / 2
        last = found.rounds + (_MORE if cycle else _FIRST)
        while found.rounds < last and not found.is_over and monotonic() < until:
            begin = monotonic()
            found.advance(twin)
            self.advance(monotonic() - begin, f"round {found.rounds} on the surrogate")

    # The proof on the FMU.

    @property
    def _episodes(self) -> int:
        """How many episodes of the FMU prove an agent."""
        return (
            2 if self.length == self.found.probe.most_steps and not self.found.probe.is_same else 1
        )

    @property
    def _left(self) -> int:
        """How many agents may be proved with the steps that are left."""
        return int((self.steps - self.arena.steps) // (self.length * self._episodes))

    def _prove(self) -> None:
        """Let the baseline and the best policies play on the FMU."""
        found = self.found
        ranked = sorted(found.policies, key=lambda one: one.merit, reverse=True)
        proved = [one.agent for one in self.proofs]
        best = [one.best for one in ranked if one.best]
        agents = [one for one in best[:2] if not any(one is other for other in proved)]
        if found.baseline and not self.proofs:
            agents.insert(0, found.baseline.best)
        for agent in agents[: self._left]:
            seeds = range(_PROVED, _PROVED + self._episodes)
            self.proofs.append(Proof(agent, seeds, agent.play(self.arena, seeds)))

    def _values(self, twin: Arena) -> list[Value]:
        """How good the agents are that have played on the FMU."""
        return [self._value(one, twin) for one in self.proofs]

    def _value(self, proof: Proof, twin: Arena) -> Value:
        same = proof.agent.play(twin, proof.seeds)
        count = 1 if self.found.probe.is_same else _PREDICTED
        many = proof.agent.play(twin, range(_TOLD, _TOLD + count))
        corrected = many._replace(
            returns=many.returns + (proof.measured.returns - same.returns).mean(),
            costs=many.costs + (proof.measured.costs - same.costs).mean(axis=1, keepdims=True),
        )
        measured, predicted = (float(one.returns.mean()) for one in (proof.measured, same))
        return Value(corrected.merits[0], predicted, measured)

    def _tell_of(self, values: Sequence[Value]) -> None:
        """Tell what the surrogate has predicted, and what the FMU gives."""
        for proof, value in zip(self.proofs, values, strict=True):
            self.tell(
                f"{proof.agent.name}: predicted {value.predicted:.5g}, measured "
                f"{value.measured:.5g} in {len(proof.seeds)} episodes of {self.length} steps"
            )


def _is_close(values: Sequence[Value], best: int) -> bool:
    """Whether the surrogate is close enough to what the FMU gives, beside what is gained."""
    wrong = abs(values[best].predicted - values[best].measured)
    return wrong <= _CLOSE * abs(values[best].merit[1] - values[0].merit[1])


def _excitations(agent: Agent, seed: int) -> Callable[[FloatArray], Excitation]:
    """A function that makes the excitations of one group of episodes after another."""
    first = 0

    def made(rows: FloatArray) -> Excitation:
        nonlocal first
        begin, first = first, first + len(rows)
        return Excitation(_untuned(agent), seed, begin)

    return made


def _untuned(agent: Agent) -> Policy:
    """An agent whose numbers are in the middle of their ranges."""
    if has_range(agent.text):
        middle = np.full(len(search_of(agent.text).ranges), 0.5)
        return agent.with_numbers(middle).policy()
    return agent.policy() if agent.is_found else Policy(None)
