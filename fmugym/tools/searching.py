"""Training without gradients: a search of policies, its course on disk, and its result."""

from __future__ import annotations

import csv
import json
import pickle
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np

from fmugym.baselines.arena import MOST_ENVS, Arena, CeilingError
from fmugym.baselines.parsing import has_range, search_of
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, reason, shown
from fmugym.search.agent import Agent
from fmugym.search.entrants import NO_MERIT, Merit
from fmugym.search.guessing import guessed_controllers
from fmugym.search.probe import MOST_PROBED, Probe, document_of
from fmugym.search.search import EPISODES, POPULATION, Search
from fmugym.signals import ordinary
from fmugym.tools.agents import FACTS
from fmugym.tools.diary import EVALUATIONS
from fmugym.tools.judging import Verdict, judge
from fmugym.tools.training import require_new

__all__ = ["Quest", "search"]

STATE: Final = "search.pkl"
_MINUTES: Final = 1.0
_FEW: Final = 8
"""Candidates of a round where the FMU is slow."""

_ENOUGH: Final = 60
_FEWEST: Final = 20
"""Rounds that should fit with the usual candidates, and that must fit with few of them."""

_SLOW: Final = 1e-4
_GROUP: Final = 8
"""If a step takes longer than this in seconds, so many environments step together, so that an
episode that has ended is not stepped on until the longest of many ends."""

_LONGEST: Final = 2**31
"""Steps of a scenario, which has a length of its own."""

_BETWEEN_WRITES: Final = 5.0
"""Seconds."""


@dataclass(frozen=True)
class Quest:
    """What to search, and how long.

    Attributes:
        make_env: Makes the environment, in the physical form of its task.
        scenarios: By name, functions that make the environments of the test.
        folder: Where the agent is written; it must not exist, unless a search is resumed.
        minutes: Real time without the test; None for one minute, or no limit if there are rounds.
        rounds: The largest number of rounds, those of a resumed search included; None for any.
        steps: The largest number of steps of all environments together; None for any.
        envs: The largest number of environments that step together.
        candidates: Of a round; None for what fits the speed of the FMU.
        seed: Of candidates and episodes.
        episodes: Of the test, in each scenario; None for the default.
    """

    make_env: Callable[[], FMUEnv]
    scenarios: Mapping[str, Callable[[], FMUEnv]]
    folder: Path
    minutes: float | None = None
    rounds: int | None = None
    steps: int | None = None
    envs: int = MOST_ENVS
    candidates: int | None = None
    seed: int = 0
    episodes: int | None = None

    @property
    def seconds(self) -> float:
        """The real time."""
        if self.minutes is None:
            return 60.0 * _MINUTES if self.rounds is None else np.inf
        return 60.0 * self.minutes


@dataclass
class _Course:
    """What a search that is resumed goes on with."""

    search: Search
    probe: Probe
    candidates: int
    seed: int
    steps: int = 0


def search(
    quest: Quest,
    tell: Callable[[str], None],
    advance: Callable[[float, str], None],
    *,
    resume: bool = False,
) -> tuple[Verdict, dict[str, Any]]:
    """Search an agent, write it, and let it play the test.

    An interruption by Ctrl-C ends the search; the best agent until then is in the folder.

    Args:
        quest: What to search.
        tell: Gets lines of text.
        advance: Is told after each round of the seconds since the last one, and of the scores.
        resume: Whether to go on with the search in the folder.

    Returns:
        The verdict, and the facts of the agent.

    Raises:
        ConfigError: If no policy can be searched for the task, or there is nothing to resume.
        FileExistsError: If the folder exists, unless a search is resumed.
    """
    begin = monotonic()
    if resume:
        course = _resumed(quest)
    else:
        require_new(quest.folder, STATE)
        course = _begun(quest, tell)
        quest.folder.mkdir(parents=True, exist_ok=True)
    is_enough = _is_enough(quest, course, begin, tell)
    _tell_of_the_plan(quest, course, tell)
    winner = _Run(quest, course, tell, advance, begin, is_enough).run()
    if winner is None:
        raise ConfigError(
            f"{course.search.rounds} rounds are too few to find anything: give more --minutes, "
            "--rounds or --steps"
        )
    return _judged(quest, course, winner, tell)


def _begun(quest: Quest, tell: Callable[[str], None]) -> _Course:
    if quest.steps is not None and quest.steps <= MOST_PROBED:
        raise ConfigError(
            f"{quest.steps} steps are too few: a look at the task takes {MOST_PROBED} at most"
        )
    probe = Probe.of(quest.make_env, quest.envs)
    for line in _warnings(probe):
        tell(line)
    fixed, tunable = _declared(probe)
    guesses: list[str] = []
    if not fixed and not tunable and probe.document:
        with closing(quest.make_env()) as env:
            guesses = guessed_controllers(probe.document, env)
    tell(_told_baseline([one.name for one in fixed], list(tunable), guesses))
    episodes = 1 if probe.is_same else EPISODES
    is_slow = probe.round_time(POPULATION, episodes) * _ENOUGH > quest.seconds
    candidates = quest.candidates or (_FEW if is_slow else POPULATION)
    made = Search(
        (len(probe.names), probe.acting),
        fixed,
        {name: search_of(text) for name, text in tunable.items()},
        [search_of(text) for text in guesses],
        list(probe.limits.values()),
        candidates,
        episodes,
        quest.seed,
    )
    return _Course(made, probe, candidates, quest.seed, probe.steps)


def _warnings(probe: Probe) -> list[str]:
    found = []
    if probe.only_reward is not None:
        found.append(
            f"the reward has been {probe.only_reward:g} in each step: what is to be learned?"
        )
    if probe.length is None:
        found.append(f"episodes have no length; they are stopped after {probe.most_steps} steps")
    return [f"warning: {text}" for text in found]


def _declared(probe: Probe) -> tuple[list[Agent], dict[str, str]]:
    """The controllers of the task: those that are ready, and the texts of those with ranges."""
    given = probe.document.get("controllers", {})
    tunable = {name: one for name, one in given.items() if has_range(one)}
    ready = [
        Agent(name, one) if isinstance(one, str) else Agent.constant(name, one, probe.ranges)
        for name, one in given.items()
        if name not in tunable
    ]
    return ready, tunable


def _told_baseline(fixed: list[str], tunable: list[str], guesses: list[str]) -> str:
    declared = [*fixed, *(f"{name} (to be tuned)" for name in tunable)]
    if declared:
        return f"to be beaten: {', '.join(declared)}, as the task declares"
    if guesses:
        return (
            f"to be beaten: the best of {len(guesses)} PI controllers for the differences in the "
            "reward, since the task declares no controllers"
        )
    return "to be beaten: the best constant action, since no controller suggests itself"


def _is_enough(quest: Quest, course: _Course, begin: float, tell: Callable[[str], None]) -> bool:
    """Whether the time is enough for policies, and not for the baseline only."""
    time = course.probe.round_time(_FEW, course.search.episodes)
    if time * _FEWEST <= quest.seconds - (monotonic() - begin):
        return True
    tell(
        f"a round of {_FEW} candidates takes about {time:.3g} s, so the time will do for the "
        f"baseline only; for more, give --minutes {np.ceil(time * 2 * _FEWEST / 60):.0f}"
    )
    return False


def _tell_of_the_plan(quest: Quest, course: _Course, tell: Callable[[str], None]) -> None:
    limits = []
    if np.isfinite(quest.seconds):
        limits.append(f"for {quest.seconds:g} s")
    if quest.rounds is not None:
        limits.append(f"until round {quest.rounds}")
    if quest.steps is not None:
        limits.append(f"for at most {quest.steps} steps")
    kind = "one episode, as all are the same" if course.probe.is_same else "new episodes"
    tell(
        f"{course.candidates} candidates at a time play {kind} of up to "
        f"{course.probe.most_steps} steps, {' and '.join(limits)}"
    )


def _arena(quest: Quest, probe: Probe, make_env: Callable[[], Any]) -> Arena:
    most_steps = probe.most_steps if make_env is quest.make_env else _LONGEST
    envs = quest.envs if probe.seconds < _SLOW else min(quest.envs, _GROUP)
    return Arena(make_env, envs, most_steps, list(probe.limits))


class _Run:
    """Lets a search go on until its time is over, and writes what it has found.

    Args:
        quest: What to search.
        course: The search.
        tell, advance: As for ``search``.
        begin: When the time has begun.
        is_enough: Whether the time is enough for policies, too.
    """

    def __init__(
        self,
        quest: Quest,
        course: _Course,
        tell: Callable[[str], None],
        advance: Callable[[float, str], None],
        begin: float,
        is_enough: bool,
    ) -> None:
        self._quest, self._course, self._is_enough = quest, course, is_enough
        self._tell, self._advance = tell, advance
        self._begin, self._written = begin, monotonic()
        self._arena = _arena(quest, course.probe, quest.make_env)
        self._arena.steps = self._steps_before = course.steps
        self._most = quest.steps or np.inf
        self._noted = NO_MERIT if course.search.baseline is None else self._best()

    def run(self) -> Agent | None:
        """Search, and return the winner of the last validation; None if nothing was found.

        What was found is written also if an exception ends the search. What was done in the round
        that it has interrupted is forgotten, so that those who resume or repeat the search come to
        the same agent.
        """
        self._keep()
        try:
            with closing(self._arena):
                self._search()
        finally:
            self._course.search = pickle.loads(self._kept)
            self._write()
        self._tell(self._text())
        winner = self._winner()
        self._write_state()
        return winner

    def _search(self) -> None:
        last, took = monotonic(), 0.0
        while not self._is_over(took):
            self._arena.ceiling = self._most - self._reserved()
            try:
                self._course.search.advance(self._arena)
            except CeilingError:
                return
            if self._arena.steps > self._most - self._reserved():
                return
            self._keep()
            self._note()
            now = monotonic()
            last, took = now, now - last
            self._advance(took, self._text())

    def _winner(self) -> Agent | None:
        with closing(_arena(self._quest, self._course.probe, self._quest.make_env)) as arena:
            arena.steps, arena.ceiling = self._course.steps, self._most
            try:
                return self._course.search.winner(arena)
            except CeilingError:  # no round has had enough steps
                return None
            finally:
                self._course.steps = arena.steps

    def _reserved(self) -> int:
        """The steps that the last validation may take."""
        agents, seeds = self._course.search.last_validation()
        return len(agents) * self._arena.most_of(len(seeds)) if len(agents) > 1 else 0

    def _keep(self) -> None:
        """Remember the search as it is between two rounds."""
        self._kept = pickle.dumps(self._course.search)

    def _is_over(self, took: float) -> bool:
        """Whether the search ends, with or without time for another round like the last one."""
        found, rounds = self._course.search, self._quest.rounds
        if found.is_over or (rounds is not None and found.rounds >= rounds):
            return True
        if not self._is_enough and found.is_tuned and found.baseline is None:
            return True
        now = monotonic()
        done = self._arena.steps - self._steps_before
        pace = (now - self._begin) / done if done else self._course.probe.seconds
        return now - self._begin + took + self._reserved() * pace >= self._quest.seconds

    def _best(self) -> Merit:
        return max((merit for _, merit in self._course.search.known()), default=NO_MERIT)

    def _text(self) -> str:
        """The scores, for a line of progress."""
        found, merit = self._course.search, self._best()
        best = f", best {merit[1]:.6g}" if merit > NO_MERIT else ""
        beside = (
            f", {found.baseline.name} {found.merit_of_baseline[1]:.6g}" if found.baseline else ""
        )
        return f"round {found.rounds}{best}{beside}"

    def _note(self) -> None:
        """Add a line to the curve if a better agent than the baseline was found."""
        found, best = self._course.search, self._best()
        if found.baseline is not None and best > self._noted:
            self._noted = best
            path = self._quest.folder / EVALUATIONS
            is_new = not path.exists()
            with path.open("a", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                if is_new:
                    writer.writerow(["steps", "reward", found.baseline.name])
                writer.writerow([self._arena.steps, best[1], found.merit_of_baseline[1]])
        if monotonic() - self._written > _BETWEEN_WRITES:
            self._write()

    def _write(self) -> None:
        """Write the best agent until now, and the state of the search."""
        self._written, self._course.steps = monotonic(), self._arena.steps
        known = self._course.search.known()
        if known:
            best, _ = max(known, key=lambda one: one[1])
            _save(self._quest.folder, self._course, best)
        self._write_state()

    def _write_state(self) -> None:
        path = self._quest.folder / STATE
        part = path.with_suffix(".part")
        part.write_bytes(pickle.dumps(self._course))
        part.replace(path)


def _save(folder: Path, course: _Course, agent: Agent) -> dict[str, Any]:
    """Write an agent and its facts."""
    probe, found = course.probe, course.search
    agent = replace(agent, names=probe.names, actions=probe.actions)
    agent.save(folder)
    facts = {
        "algorithm": "search",
        "agent": agent.name,
        "baseline": (found.baseline or agent).name,
        "controller": agent.text,
        "rounds": found.rounds,
        "candidates": course.candidates,
        "seed": course.seed,
        "steps": course.steps,
    }
    (folder / FACTS).write_text(json.dumps(facts), encoding="utf-8")
    return facts


def _resumed(quest: Quest) -> _Course:
    """Read the state of a search; it is a pickle, which can run code.

    Raises:
        ConfigError: If there is none, it is damaged, or it is of another task.
    """
    folder = quest.folder
    try:
        course = pickle.loads((folder / STATE).read_bytes())
    except FileNotFoundError:
        raise ConfigError(f"{shown(str(folder))} has no search to resume") from None
    except ordinary(Exception) as error:  # a damaged file may raise anything
        raise ConfigError(
            f"the search in {shown(str(folder))} cannot be resumed: {reason(error)}"
        ) from None
    if not isinstance(course, _Course):
        raise ConfigError(f"{STATE} in {shown(str(folder))} is of something else")
    probe = course.probe
    with closing(quest.make_env()) as env:
        Agent("", None, names=probe.names, actions=probe.actions).policy().bind(env)
        now = document_of(env)
    changed = [key for key in {**probe.document, **now} if probe.document.get(key) != now.get(key)]
    if changed:
        raise ConfigError(
            f"the search in {shown(str(folder))} is of a task with another {', '.join(changed)}"
        )
    return course


def _judged(
    quest: Quest, course: _Course, winner: Agent, tell: Callable[[str], None]
) -> tuple[Verdict, dict[str, Any]]:
    """Write the winner, and let it play beside the others."""
    facts = _save(quest.folder, course, winner)
    found = course.search
    if winner is found.baseline:
        tell(f"nothing was found that beats {winner.name}: the folder has that controller")
    agents = {winner.name: winner}
    for other in [found.baseline or winner, *found.others()]:
        agents.setdefault(other.name, other)
    verdict = judge(
        agents,
        quest.scenarios,
        lambda make_env: _arena(quest, course.probe, make_env),
        course.probe.limits,
        1 if course.probe.is_same else quest.episodes,
    )
    facts |= {"test": verdict.as_dict()}
    (quest.folder / FACTS).write_text(json.dumps(facts), encoding="utf-8")
    return verdict, facts
