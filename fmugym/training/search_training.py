"""Training by a search of policies: rounds, files in its folder, and the result.

The result is compared with other agents over episodes that no search has seen.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np

from fmugym.control.candidate_evaluation import (
    MOST_ENVS,
    CandidateEvaluator,
    CandidateScores,
    CeilingError,
)
from fmugym.control.controller_parsing import plans_ahead, warmed
from fmugym.control.surrogate.recorded_trajectories import Trajectories
from fmugym.control.tuning import NO_MERIT
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, reading_file, reason, shown
from fmugym.files import replaced_together
from fmugym.pool.machine_limits import available_processors
from fmugym.records.episode_statistics import confidence
from fmugym.records.evaluation import HELD_OUT_SEED
from fmugym.records.progress_bars import Advance, no_progress
from fmugym.training.agents import AGENT_FILE
from fmugym.training.sb3_training import VERY_SLOW, require_new
from fmugym.training.search.policy import POLICY_FILE, ResidualAgent
from fmugym.training.search.policy_search import Search
from fmugym.training.search.probe import FEW, MOST_PROBED, Probe, agent_task
from fmugym.training.search.search_file import bytes_of, plain_of, search_in
from fmugym.training.search.suggested_controllers import MOST_TESTED
from fmugym.training.search.surrogate_search import TwinSearch
from fmugym.training.training_records import append_row

__all__ = ["STATE", "Searching", "judge", "verdict"]


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


STATE: Final = "search.npz"
_MINUTES: Final = 1.0
_FEWEST: Final = 20
"""Rounds for controllers that must fit the time, so that policies are searched, too."""

_ENOUGH: Final = 100
"""In the time of so many, policies come to gain, too."""

_TESTED: Final = 4
"""The steps of an FMU by which controllers are guessed are at most one in so many."""

_SLOW: Final = 3e-4
_GROUP: Final = 8
"""If a step takes longer than this in seconds, so many environments step together at most: more
would hardly be faster, and take long to open."""

_LONGEST: Final = 2**31
"""Steps of a scenario, which has a length of its own."""

_EPISODES: Final = 100
_LEAST: Final = 200
_OF_PROBE: Final = 20
"""The probe takes one step, and one second, of so many."""

_OF_TEST: Final = 6
_FEWEST_TESTED: Final = 4
"""A test of an agent that was searched on a surrogate takes this part of the time of the search,
or so many episodes."""

_MOST_OF_FMU: Final = 20_000
"""A surrogate hardly gains from more steps of the FMU."""

_OF_SCENARIO: Final = 4
"""Episodes of a test, and of each scenario if the task has some."""

_TRIED: Final = 2
"""Steps that measure the time of a controller that plans ahead."""


@dataclass
class Searching:
    """Run of a search, which writes its results to a folder and tests them.

    Attributes:
        make_env: Makes the environment, in the physical form of its task.
        scenarios: By name, functions that make the environments of the test.
        folder: Folder of the new agent; it must not exist, unless a search is resumed.
        minutes: Real time of all but the test; None for one minute, or no limit if there are
            rounds.
        rounds: The largest number of rounds, those of a resumed search included.
        steps: The largest number of steps of all environments together, in all but the test.
        envs: The largest number of environments that step together.
        seed: Seed of candidates and episodes.
        episodes: Number of episodes of the test, in each scenario; None for the default.
        tell: Gets lines of text.
        advance: Is told after each round of the seconds since the last one, and of the scores.
        progress: Shows how far a part of the work is, of which it gets the seconds that it takes
            about, and a word.
    """

    make_env: Callable[[], FMUEnv]
    scenarios: Mapping[str, Callable[[], FMUEnv]]
    folder: Path
    minutes: float | None = None
    rounds: float = np.inf
    steps: float = np.inf
    envs: int = MOST_ENVS
    seed: int = 0
    episodes: int | None = None
    tell: Callable[[str], None] = lambda line: None
    advance: Advance = no_progress
    progress: Callable[[float, str], AbstractContextManager[Advance]] = lambda seconds, what: (
        nullcontext(no_progress)
    )

    @property
    def seconds(self) -> float:
        """The real time."""
        return 60.0 * (self.minutes or (_MINUTES if np.isinf(self.rounds) else np.inf))

    def run(self, *, resume: bool = False) -> dict[str, Any]:
        """Search an agent, write it, and let it play the test.

        An interruption by Ctrl-C ends the search; the best agent until then is in the folder.

        Args:
            resume: Whether to go on with the search in the folder.

        Returns:
            The facts of the agent.

        Raises:
            ConfigError: If no policy can be searched for the task, there is nothing to resume, or
                the rounds are too few to find anything.
            FileExistsError: If the folder exists, unless a search is resumed.
        """
        self._begin = monotonic()
        self._seconds_of: dict[str, float] = {}
        self._trajectories = Trajectories()
        self._found = self._resumed() if resume else self._begun()
        self._probe, self._before = self._found.probe, self._found.steps
        self._tell_the_plan(resume)
        try:
            with closing(
                self._evaluator_of(self.make_env, self._probe.most_steps)
            ) as self._evaluator:
                self._evaluator.steps = self._before
                self._evaluator.backend = self._trajectories if self._on_surrogate else "auto"
                winner = self._winner()
            return self._judged(winner)
        finally:
            with suppress(OSError):  # something was found, so that the folder is not empty
                self.folder.rmdir()

    def _begun(self) -> Search:
        require_new(self.folder)
        if self.steps < _LEAST:
            raise ConfigError(f"{self.steps} steps are too few: give {_LEAST} or more")
        most = int(min(MOST_PROBED, self.steps // _OF_PROBE))
        tested = int(min(MOST_TESTED, (self.steps - most) / _TESTED))
        backend = "auto" if most == MOST_PROBED else self._trajectories
        seconds = self.seconds / _OF_PROBE
        probe = Probe.of(self.make_env, self.envs, self.tell, most, backend, seconds, tested)
        agents = (one.name + " (to be tuned)" * (not one.is_found) for one in probe.agents)
        self.tell(f"to be beaten: {', '.join(dict.fromkeys(agents))}")
        self.folder.mkdir(parents=True, exist_ok=True)
        return Search(probe, self.seed)

    def _resumed(self) -> Search:
        """Read the state of a search.

        Raises:
            ConfigError: If there is none, it is damaged, or it is of another task.
        """
        name = shown(str(self.folder))
        with reading_file(f"{name} has no search to resume"):
            found = search_in((self.folder / STATE).read_bytes())
        with closing(self.make_env()) as env:
            before, now = plain_of(found.probe.task), plain_of(agent_task(env))
        changed = [key for key in {**before, **now} if before.get(key) != now.get(key)]
        if changed:
            raise ConfigError(
                f"the search in {name} is of a task that differs in {', '.join(changed)}"
            )
        return found

    def _evaluator_of(self, make_env: Callable[[], Any], most_steps: int) -> CandidateEvaluator:
        seconds, group = self._probe.seconds, self.envs
        if seconds > _SLOW:
            group = min(group, _GROUP if seconds < VERY_SLOW else available_processors())
        return CandidateEvaluator(make_env, group, most_steps, self._probe.limits)

    def _tell_the_plan(self, is_resumed: bool) -> None:
        """Tell the plan and its duration."""
        probe = self._probe
        took = probe.round_time(self._found.episodes)
        left = self.seconds - (monotonic() - self._begin)
        self._is_enough = took * _FEWEST <= left
        too_long = FEW * self._found.episodes * probe.usual_steps * _FEWEST > self.steps
        self._on_surrogate = not is_resumed and (too_long or not self._is_enough)
        self._on_surrogate = self._on_surrogate and self._is_fmu()
        if self._on_surrogate:
            self.tell(
                f"{_FEWEST} rounds of {FEW} candidates with episodes of {probe.usual_steps} steps "
                "would take too long: the search plays on a surrogate of the FMU"
            )
            return
        if took * _ENOUGH > left:
            who = "policies may hardly gain" if self._is_enough else "only the baseline is tuned"
            self.tell(
                f"a round of {FEW} candidates takes about {took:.3g} s with episodes of "
                f"{probe.usual_steps} steps, so that {who}; for more, "
                f"give --minutes {np.ceil(took * _ENOUGH / 60):.0f}"
            )
        limits = (
            f"for {self.seconds:g} s",
            f"until round {self.rounds}",
            f"for at most {self.steps} steps",
        )
        kind = "one episode (all are the same)" if probe.is_same else "new episodes"
        self.tell(
            f"candidates play {kind} of up to {probe.most_steps} steps, "
            + " and ".join(text for text in limits if str(np.inf) not in text)
        )

    def _is_fmu(self) -> bool:
        """Whether an FMU steps, and nothing in its place."""
        with closing(self.make_env()) as env:
            return env.given_backend is None

    def _winner(self) -> ResidualAgent:
        """Search, and find the winner of the last validation.

        What was found is written also if an exception ends the search.

        Raises:
            ConfigError: If nothing was found.
            CeilingError: If no round has had enough steps.
        """
        if self._on_surrogate:
            return self._proved()
        try:
            self._go_on()
        finally:
            if self._found.ahead.merit > NO_MERIT:
                self._save(self._found.ahead.best)
        self.tell(self._text())
        self._evaluator.ceiling = self.steps
        winner = self._found.winner(self._evaluator)
        if winner is None:
            raise ConfigError(
                f"{self._found.rounds} rounds are too few to find anything: give more --minutes, "
                "--rounds or --steps"
            )
        self._save(winner)
        return winner

    def _proved(self) -> ResidualAgent:
        """Search on a surrogate of the FMU, and find the agent that is best on the FMU.

        What was found is written also if an exception ends the search.
        """
        left = self.seconds - (monotonic() - self._begin)
        limited = self.minutes is None and self.steps < np.inf
        steps = min(self.steps, _MOST_OF_FMU, self._before + left / 2 / self._probe.seconds)
        twin = TwinSearch(
            self._found,
            self._evaluator,
            self._trajectories,
            self.steps if limited else steps,
            np.inf if limited else left,
            self.rounds,
            self.tell,
            self.advance,
        )
        try:
            return twin.winner()
        finally:
            if twin.best is not None:
                self._save(twin.best)

    def _go_on(self) -> None:
        """Go on round by round.

        What an exception or the ceiling interrupts is a copy, so that those who resume or repeat
        the search come to the same agent.
        """
        longest = 0.0
        while not self._is_over(longest):
            begin, before = monotonic(), self._found
            self._evaluator.ceiling = self.steps - self._reserved(before)
            found = copy.deepcopy(before)
            try:
                found.advance(self._evaluator)
            except CeilingError:
                return
            if self._evaluator.steps > self.steps - self._reserved(found):
                return
            self._found = found
            ahead, base = found.ahead, found.baseline
            if base and (before.baseline is None or ahead.merit > before.ahead.merit):
                row = self._evaluator.steps, ahead.merit[1], base.merit[1]
                append_row(self.folder, ("steps", "reward", "baseline"), row)
                self._save(ahead.best)
            took = monotonic() - begin
            longest = max(longest, took)
            self.advance(took, self._text())

    def _reserved(self, found: Search) -> int:
        """The steps that the last validation may take."""
        agents, seeds = found.last_validation()
        return len(agents) * len(seeds) * self._probe.most_steps

    def _is_over(self, longest: float) -> bool:
        """Whether there is no time for another round like the longest, or nothing left to do."""
        found = self._found
        goes_on = self._is_enough or found.tuning or found.baseline
        if found.is_over or found.rounds >= self.rounds or not goes_on:
            return True
        done, seconds = self._evaluator.steps - self._before, monotonic() - self._begin
        # all episodes may end before they are as long as they may be
        pace = seconds / (done or 1) * self._evaluator.longest / self._probe.most_steps
        return seconds + longest + self._reserved(found) * pace >= self.seconds

    def _text(self) -> str:
        """The scores, for a line of progress."""
        ahead, base = self._found.ahead, self._found.baseline
        text = f"round {self._found.rounds}"
        text += f", best {ahead.merit[1]:.6g}" if ahead.merit > NO_MERIT else ""
        return text + (f", {base.best.name} {base.merit[1]:.6g}" if base else "")

    def _save(self, agent: ResidualAgent, **more: Any) -> dict[str, Any]:
        """Write an agent, its facts, and the state of the search."""
        found, task = self._found, self._probe.task
        found.steps = self._evaluator.steps
        facts = {
            "algorithm": "search",
            "agent": agent.name,
            "baseline": found.baseline.best.name if found.baseline else agent.name,
            "controller": agent.text,
            "rounds": found.rounds,
            "seed": found.seed,
            "steps": found.steps,
            **({"surrogate": True} if self._on_surrogate else {}),
            **more,
        }
        named = replace(agent, names=task["observations"], actions=task["actions"])
        with replaced_together() as beside:
            beside(self.folder / POLICY_FILE).write_bytes(named.content())
            if not self._on_surrogate:  # whose search cannot be resumed
                beside(self.folder / STATE).write_bytes(bytes_of(found))
            beside(self.folder / AGENT_FILE).write_text(json.dumps(facts), encoding="utf-8")
        return facts

    def _judged(self, winner: ResidualAgent) -> dict[str, Any]:
        """Compare the winner with the others, and write the result."""
        probe, found = self._probe, self._found
        baseline = found.baseline.best if found.baseline else winner
        if found.baseline and winner is baseline:
            self.tell(f"nothing was found that beats {winner.name}: the folder has that controller")
        evaluators = {
            name: self._evaluator_of(make, probe.most_steps if make is self.make_env else _LONGEST)
            for name, make in self.scenarios.items()
        }
        usual = _EPISODES if len(evaluators) < 2 else _OF_SCENARIO
        count = 1 if probe.is_same else self.episodes or usual
        if self._on_surrogate and self.episodes is None and self.minutes:
            most = self.seconds / _OF_TEST / probe.seconds / probe.most_steps / len(evaluators)
            count = min(count, max(_FEWEST_TESTED, int(most)))
        agents = {winner.name: winner}
        planners = self._planners(baseline.text, count * len(evaluators))
        others = (one.best for one in found.controllers)
        for other in filter(None, [baseline, *others, *planners]):
            agents.setdefault(other.name, other)
        test = self._test(agents, evaluators, count)
        text = f"no verdict: {winner.name} could not play the test"
        if winner.name in test:
            text = verdict(test, probe.limits)
        return self._save(winner, test=test, verdict=text)

    def _test(
        self,
        agents: Mapping[str, ResidualAgent],
        evaluators: Mapping[str, CandidateEvaluator],
        count: int,
    ) -> dict[str, Any]:
        """Let agents play, with a progress bar; a failure of one does not end the test."""
        usual = self._probe.seconds * self._probe.usual_steps * count * len(evaluators)
        seconds = {name: self._seconds_of.get(name, usual) for name in agents}
        with self.progress(sum(seconds.values()), "test") as advance:
            return judge(
                agents,
                evaluators,
                count,
                self._leave_out,
                lambda name, part: advance(part * seconds[name]),
            )

    def _leave_out(self, name: str, error: Exception) -> None:
        self.tell(f"left out: {name}: {reason(error)}")

    def _planners(self, baseline: str | None, episodes: int) -> Iterator[ResidualAgent]:
        """The controllers that plan ahead and whose test takes no longer than the search.

        They begin with the plan of the baseline.

        Args:
            baseline: The text of a controller.
            episodes: Number of episodes of the test. Its first steps tell how long a step takes.
        """
        for name, text in self._probe.task.get("controllers", {}).items():
            if not plans_ahead(text):
                continue
            try:
                agent = ResidualAgent(name, warmed(text, baseline))
                with closing(CandidateEvaluator(self.make_env, most_steps=_TRIED)) as evaluator:
                    agent.play(evaluator, range(1))
            except Exception as error:
                self._leave_out(name, error)
                continue
            seconds = evaluator.seconds / evaluator.steps * self._probe.most_steps * episodes
            if seconds <= 60.0 * (self.minutes or _MINUTES):
                self._seconds_of[name] = seconds
                yield agent
            else:
                self.tell(
                    f"left out: {name}, whose test would take about {seconds / 60.0:.0f} min; "
                    "'fmugym evaluate' compares it with the agent"
                )
