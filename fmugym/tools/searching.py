"""Training without gradients: a search of policies, its course on disk, and its result."""

from __future__ import annotations

import csv
import json
import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np

from fmugym.baselines.arena import MOST_ENVS, Arena, CeilingError
from fmugym.baselines.entrants import NO_MERIT, Merit
from fmugym.baselines.parsing import controller_of, has_range, plans_ahead, search_of, warmed
from fmugym.env import FMUEnv
from fmugym.episodes.progress_bars import Advance, no_progress
from fmugym.errors import ConfigError, reason, shown
from fmugym.search.agent import Agent
from fmugym.search.guessing import guessed_controllers
from fmugym.search.probe import MOST_PROBED, Probe, document_of
from fmugym.search.search import EPISODES, POPULATION, Search
from fmugym.signals import Ignoring, ordinary
from fmugym.tools.comparing import Verdict, episodes_of, judge
from fmugym.training.agents import FACTS
from fmugym.training.diary import EVALUATIONS
from fmugym.training.training import require_new

__all__ = ["STATE", "Quest", "search"]

STATE: Final = "search.pkl"
_MINUTES: Final = 1.0
_FEW: Final = 8
"""Candidates of a round where the FMU is slow."""

_ENOUGH: Final = 60
_FEWEST: Final = 20
"""Rounds that should fit with the usual candidates, and that must fit with few of them."""

_SLOW: Final = 1e-4
_GROUP: Final = 8
"""If a step takes longer than this in seconds, so many environments step together: more would
hardly be faster, and take long to open."""

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
        minutes: Real time of all but the test; None for one minute, or no limit if there are
            rounds.
        rounds: The largest number of rounds, those of a resumed search included; None for any.
        steps: The largest number of steps of all environments together, in all but the test; None
            for any.
        envs: The largest number of environments that step together.
        candidates: Of a round; None for what fits the speed of the FMU.
        seed: Of candidates and episodes.
        episodes: Of the test, in each scenario; None for the default.
        tell: Gets lines of text.
        advance: Is told after each round of the seconds since the last one, and of the scores.
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
    tell: Callable[[str], None] = lambda line: None
    advance: Advance = no_progress

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
    steps: int


def search(quest: Quest, *, resume: bool = False) -> tuple[Verdict, dict[str, Any]]:
    """Search an agent, write it, and let it play the test.

    An interruption by Ctrl-C ends the search; the best agent until then is in the folder.

    Args:
        quest: What to search.
        resume: Whether to go on with the search in the folder.

    Returns:
        The verdict, and the facts of the agent.

    Raises:
        ConfigError: If no policy can be searched for the task, there is nothing to resume, or the
            rounds are too few to find anything.
        FileExistsError: If the folder exists, unless a search is resumed.
    """
    begin = monotonic()
    course = _resumed(quest) if resume else _begun(quest)
    try:
        run = _Run(quest, course, begin)
        run.tell_the_plan()
        return run.judged(run.winner())
    finally:
        with Ignoring(OSError):  # something was found, so that the folder is not empty
            quest.folder.rmdir()


def _begun(quest: Quest) -> _Course:
    require_new(quest.folder)
    if quest.steps is not None and quest.steps <= MOST_PROBED:
        raise ConfigError(
            f"{quest.steps} steps are too few: a look at the task takes {MOST_PROBED} at most"
        )
    probe = Probe.of(quest.make_env, quest.envs)
    declared = probe.document.get("controllers", {})
    given = {name: one for name, one in declared.items() if not plans_ahead(one)}
    tunable = {name: search_of(one) for name, one in given.items() if has_range(one)}
    fixed = [
        Agent(name, one) if isinstance(one, str) else Agent.constant(name, one, probe.ranges)
        for name, one in given.items()
        if name not in tunable
    ]
    guesses: list[str] = []
    if not given and probe.document:
        with closing(quest.make_env()) as env:
            guesses = guessed_controllers(probe.document, env)
    for line in _first_lines(probe, [one.name for one in fixed], list(tunable), len(guesses)):
        quest.tell(line)
    episodes = 1 if probe.is_same else EPISODES
    is_slow = probe.round_time(POPULATION, episodes) * _ENOUGH > quest.seconds
    made = Search(
        (len(probe.names), probe.acting),
        fixed,
        tunable,
        [search_of(text) for text in guesses],
        list(probe.limits.values()),
        quest.candidates or (_FEW if is_slow else POPULATION),
        episodes,
        quest.seed,
    )
    quest.folder.mkdir(parents=True, exist_ok=True)
    return _Course(made, probe, MOST_PROBED)


def _first_lines(probe: Probe, fixed: list[str], tunable: list[str], guesses: int) -> Iterator[str]:
    """What may be wrong with the task, and what is to be beaten."""
    if probe.only_reward is not None:
        yield (
            f"warning: the reward has been {probe.only_reward:g} in each step: what is to be "
            "learned?"
        )
    if probe.length is None:
        yield (f"warning: episodes have no length; they are stopped after {probe.most_steps} steps")
    if fixed or tunable:
        names = ", ".join([*fixed, *(f"{name} (to be tuned)" for name in tunable)])
        yield f"to be beaten: {names}, as the task declares"
    elif guesses:
        yield (
            f"to be beaten: the best of {guesses} PI controllers for the differences in the "
            "reward, since the task declares no controllers"
        )
    else:
        yield "to be beaten: the best constant action, since no controller suggests itself"


class _Run:
    """Lets a search go on until its time is over, and writes what it has found.

    Args:
        quest: What to search.
        course: The search.
        begin: When the time has begun.
    """

    def __init__(self, quest: Quest, course: _Course, begin: float) -> None:
        self._quest, self._course = quest, course
        self._begin, self._written = begin, monotonic()
        self._arena = self._arena_of(quest.make_env, course.probe.most_steps)
        self._arena.steps = self._steps_before = course.steps
        self._most = quest.steps or np.inf
        self._few = course.probe.round_time(_FEW, course.search.episodes)
        self._is_enough = self._few * _FEWEST <= quest.seconds - (monotonic() - begin)
        self._noted = NO_MERIT if course.search.baseline is None else self._best()

    def _arena_of(self, make_env: Callable[[], Any], most_steps: int) -> Arena:
        envs, probe = self._quest.envs, self._course.probe
        group = envs if probe.seconds < _SLOW else min(envs, _GROUP)
        return Arena(make_env, group, most_steps, list(probe.limits))

    def tell_the_plan(self) -> None:
        """Tell what will be done, and how long."""
        quest, probe, limits = self._quest, self._course.probe, []
        if not self._is_enough:
            quest.tell(
                f"a round of {_FEW} candidates takes about {self._few:.3g} s, so the time will do "
                "for the baseline only; for more, give --minutes "
                f"{np.ceil(self._few * 2 * _FEWEST / 60):.0f}"
            )
        if np.isfinite(quest.seconds):
            limits.append(f"for {quest.seconds:g} s")
        if quest.rounds is not None:
            limits.append(f"until round {quest.rounds}")
        if quest.steps is not None:
            limits.append(f"for at most {quest.steps} steps")
        kind = "one episode, as all are the same" if probe.is_same else "new episodes"
        quest.tell(
            f"{self._course.search.population} candidates at a time play {kind} of up to "
            f"{probe.most_steps} steps, {' and '.join(limits)}"
        )

    def winner(self) -> Agent:
        """Search, and find the winner of the last validation.

        What was found is written also if an exception ends the search. What was done in the round
        that it has interrupted is forgotten, so that those who resume or repeat the search come to
        the same agent.

        Raises:
            ConfigError: If nothing was found.
        """
        with closing(self._arena):
            self._keep()
            try:
                self._search()
            finally:
                self._course.search = pickle.loads(self._kept)
                self._write(self._leader())
            self._quest.tell(self._text())
            self._arena.ceiling = self._most
            found = self._course.search
            try:
                winner = found.winner(self._arena)
            except CeilingError:  # no round has had enough steps
                winner = None
            if winner is None:
                raise ConfigError(
                    f"{found.rounds} rounds are too few to find anything: give more --minutes, "
                    "--rounds or --steps"
                )
            self._write(winner)
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
            self._quest.advance(took, self._text())

    def _reserved(self) -> int:
        """The steps that the last validation may take."""
        agents, seeds = self._course.search.last_validation()
        episodes = len(agents) * len(seeds) if len(agents) > 1 else 0
        return episodes * self._course.probe.most_steps

    def _keep(self) -> None:
        """Remember the search as it is between two rounds."""
        self._kept = pickle.dumps(self._course.search)

    def _is_over(self, took: float) -> bool:
        """Whether there is no time for another round like the last one, or nothing left to do."""
        found, rounds = self._course.search, self._quest.rounds
        if found.is_over or (rounds is not None and found.rounds >= rounds):
            return True
        if not self._is_enough and found.is_tuned and found.baseline is None:
            return True
        done, seconds = self._arena.steps - self._steps_before, monotonic() - self._begin
        pace = seconds / done if done else self._course.probe.seconds
        return seconds + took + self._reserved() * pace >= self._quest.seconds

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
            self._write(self._leader())

    def _leader(self) -> Agent | None:
        """The best agent until now; None if there is none."""
        known = self._course.search.known()
        return max(known, key=lambda one: one[1])[0] if known else None

    def _write(self, agent: Agent | None) -> None:
        """Write an agent and the state of the search, if there is an agent."""
        self._written = monotonic()
        if agent is None:
            return
        self._save(agent)
        self._course.steps = self._arena.steps
        path = self._quest.folder / STATE
        part = path.with_suffix(".part")
        part.write_bytes(pickle.dumps(self._course))
        part.replace(path)

    def _save(self, agent: Agent, **more: Any) -> dict[str, Any]:
        """Write an agent and its facts."""
        folder, probe, found = self._quest.folder, self._course.probe, self._course.search
        replace(agent, names=probe.names, actions=probe.actions).save(folder)
        facts = {
            "algorithm": "search",
            "agent": agent.name,
            "baseline": (found.baseline or agent).name,
            "controller": agent.text,
            "rounds": found.rounds,
            "candidates": found.population,
            "seed": found.seed,
            "steps": self._arena.steps,
            **more,
        }
        (folder / FACTS).write_text(json.dumps(facts), encoding="utf-8")
        return facts

    def judged(self, winner: Agent) -> tuple[Verdict, dict[str, Any]]:
        """Let the winner play beside the others, and write what it has reached."""
        quest, probe, found = self._quest, self._course.probe, self._course.search
        if winner is found.baseline:
            quest.tell(
                f"nothing was found that beats {winner.name}: the folder has that controller"
            )
        agents = {winner.name: winner}
        count = 1 if probe.is_same else quest.episodes
        baseline = found.baseline or winner
        for other in [baseline, *found.others(), *self._planners(baseline.text, count)]:
            agents.setdefault(other.name, other)
        arenas = {
            name: self._arena_of(make, probe.most_steps if make is quest.make_env else _LONGEST)
            for name, make in quest.scenarios.items()
        }
        verdict = judge(agents, arenas, probe.limits, count)
        return verdict, self._save(winner, test=verdict.as_dict())

    def _planners(self, baseline: str | None, episodes: int | None) -> Iterator[Agent]:
        """The controllers that plan ahead and whose test takes no longer than the search.

        They begin with the plan of the baseline.
        """
        declared = self._course.probe.document.get("controllers", {})
        for name, text in declared.items():
            if plans_ahead(text):
                warm = warmed(text, baseline)
                minutes = self._minutes_of_test(warm, episodes)
                if minutes <= (self._quest.minutes or _MINUTES):
                    yield Agent(name, warm)
                else:
                    self._quest.tell(
                        f"left out: {name}, whose test would take about {minutes:.0f} min; "
                        "'fmugym evaluate' compares it with the agent"
                    )

    def _minutes_of_test(self, text: str, episodes: int | None) -> float:
        """How long a controller would take for the test, by the time of its second decision."""
        steps = 0
        for make_env in self._quest.scenarios.values():
            with closing(make_env()) as env:
                steps += env.config.max_episode_steps or self._course.probe.most_steps
        with closing(self._quest.make_env()) as env:
            controller = controller_of(text).bind(env)
            observation, _ = env.reset(seed=self._quest.seed)
            observation, *_ = env.step(controller.act(observation))
            begin = monotonic()
            controller.act(observation)
            took = monotonic() - begin
        return took * steps * episodes_of(len(self._quest.scenarios), episodes) / 60.0


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
