"""Training without gradients: a search of policies, its course on disk, and its result."""

from __future__ import annotations

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
from fmugym.baselines.entrants import NO_MERIT
from fmugym.baselines.parsing import controller_of, has_range, plans_ahead, search_of, warmed
from fmugym.env import FMUEnv
from fmugym.episodes.progress_bars import Advance, no_progress
from fmugym.errors import ConfigError, reason, shown
from fmugym.search.agent import Agent
from fmugym.search.probe import MOST_PROBED, Probe, task_of
from fmugym.search.search import FEW, Search
from fmugym.signals import Ignoring, ordinary
from fmugym.training.agents import FACTS
from fmugym.training.comparing import Verdict, episodes_of, judge
from fmugym.training.diary import EVALUATIONS
from fmugym.training.training import require_new

__all__ = ["STATE", "SearchSettings", "search"]

STATE: Final = "search.pkl"
_MINUTES: Final = 1.0
_FEWEST: Final = 20
"""Rounds for controllers that must fit the time, so that policies are searched, too."""

_SLOW: Final = 3e-4
_GROUP: Final = 8
"""If a step takes longer than this in seconds, so many environments step together: more would
hardly be faster, and take long to open."""

_LONGEST: Final = 2**31
"""Steps of a scenario, which has a length of its own."""


@dataclass(frozen=True)
class SearchSettings:
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


_Course = tuple[Search, Probe, int]
"""What a search that is resumed goes on with: the steps are those until then."""


def search(settings: SearchSettings, *, resume: bool = False) -> tuple[Verdict, dict[str, Any]]:
    """Search an agent, write it, and let it play the test.

    An interruption by Ctrl-C ends the search; the best agent until then is in the folder.

    Args:
        settings: What to search.
        resume: Whether to go on with the search in the folder.

    Returns:
        The verdict, and the facts of the agent.

    Raises:
        ConfigError: If no policy can be searched for the task, there is nothing to resume, or the
            rounds are too few to find anything.
        FileExistsError: If the folder exists, unless a search is resumed.
    """
    begin = monotonic()
    course = _resumed(settings) if resume else _begun(settings)
    try:
        run = _Run(settings, *course, begin)
        return run.judged(run.winner())
    finally:
        with Ignoring(OSError):  # something was found, so that the folder is not empty
            settings.folder.rmdir()


def _begun(settings: SearchSettings) -> _Course:
    require_new(settings.folder)
    if settings.steps is not None and settings.steps <= MOST_PROBED:
        raise ConfigError(
            f"{settings.steps} steps are too few: a look at the task takes {MOST_PROBED} at most"
        )
    probe = Probe.of(settings.make_env, settings.envs)
    declared = probe.task.get("controllers", {})
    given = {name: one for name, one in declared.items() if not plans_ahead(one)}
    tunable = [(name, search_of(one)) for name, one in given.items() if has_range(one)]
    fixed = [
        Agent(name, one) if isinstance(one, str) else Agent.constant(name, one, probe.ranges)
        for name, one in given.items()
        if not has_range(one)
    ]
    if not given:
        tunable = [("PI", search_of(one)) for one in probe.guesses]
    for line in _first_lines(probe, given, len(tunable)):
        settings.tell(line)
    sizes = len(probe.task["observations"]), probe.acting
    limits = list(probe.limits.values())
    made = Search(sizes, fixed, tunable, limits, probe.is_same, settings.seed)
    settings.folder.mkdir(parents=True, exist_ok=True)
    return made, probe, MOST_PROBED


def _first_lines(probe: Probe, given: Mapping[str, Any], tunable: int) -> Iterator[str]:
    """What may be wrong with the task, and what is to be beaten."""
    if probe.only_return is not None:
        yield (
            f"warning: all episodes have reached {probe.only_return:g}, whatever the actions: what "
            "is to be learned?"
        )
    if probe.length is None:
        yield f"warning: episodes have no length; they are stopped after {probe.most_steps} steps"
    if given:
        names = (f"{name} (to be tuned)" if has_range(one) else name for name, one in given.items())
        yield f"to be beaten: {', '.join(names)}, as the task declares"
    elif tunable:
        yield (
            f"to be beaten: the best of {tunable} PI controllers for the differences in the "
            "reward, since the task declares no controllers"
        )
    else:
        yield "to be beaten: the best constant action, since no controller suggests itself"


class _Run:
    """Lets a search go on until its time is over, and writes what it has found.

    Args:
        settings: What to search.
        search: The search.
        probe: What is known of the task.
        steps: Those that were done before.
        begin: When the time has begun.
    """

    def __init__(
        self, settings: SearchSettings, search: Search, probe: Probe, steps: int, begin: float
    ) -> None:
        self._settings, self._found, self._probe, self._begin = settings, search, probe, begin
        self._arena = self._arena_of(settings.make_env, probe.most_steps)
        self._arena.steps = self._steps_before = steps
        self._most = settings.steps or np.inf
        self._noted = NO_MERIT if search.baseline is None else search.merit
        few = probe.round_time(FEW, search.episodes)
        self._is_enough = few * _FEWEST <= settings.seconds - (monotonic() - begin)
        self._tell_the_plan(few)

    def _arena_of(self, make_env: Callable[[], Any], most_steps: int) -> Arena:
        envs = self._settings.envs
        group = envs if self._probe.seconds < _SLOW else min(envs, _GROUP)
        return Arena(make_env, group, most_steps, list(self._probe.limits))

    def _tell_the_plan(self, few: float) -> None:
        """Tell what will be done, and how long; ``few`` are the seconds of a short round."""
        settings, probe = self._settings, self._probe
        if not self._is_enough:
            settings.tell(
                f"a round of {FEW} candidates takes about {few:.3g} s, so the time will do for the "
                f"baseline only; for more, give --minutes {np.ceil(few * 2 * _FEWEST / 60):.0f}"
            )
        limits = {
            f"for {settings.seconds:g} s": np.isfinite(settings.seconds),
            f"until round {settings.rounds}": settings.rounds,
            f"for at most {settings.steps} steps": settings.steps,
        }
        kind = "one episode, as all are the same" if probe.is_same else "new episodes"
        settings.tell(
            f"candidates play {kind} of up to {probe.most_steps} steps, "
            + " and ".join(text for text, is_given in limits.items() if is_given)
        )

    def winner(self) -> Agent:
        """Search, and find the winner of the last validation.

        What was found is written also if an exception ends the search.

        Raises:
            ConfigError: If nothing was found.
        """
        with closing(self._arena):
            try:
                self._search()
            finally:
                if self._found.best is not None:
                    self._save(self._found.best)
            self._settings.tell(self._text())
            self._arena.ceiling = self._most
            try:
                winner = self._found.winner(self._arena)
            except CeilingError:  # no round has had enough steps
                winner = None
            if winner is None:
                raise ConfigError(
                    f"{self._found.rounds} rounds are too few to find anything: give more "
                    "--minutes, --rounds or --steps"
                )
            self._save(winner)
        return winner

    def _search(self) -> None:
        """Go on round by round.

        What an exception or the ceiling interrupts is a copy, so that those who resume or repeat
        the search come to the same agent.
        """
        took = 0.0
        while not self._is_over(took):
            begin = monotonic()
            self._arena.ceiling = self._most - self._reserved(self._found)
            after = pickle.loads(pickle.dumps(self._found))
            try:
                after.advance(self._arena)
            except CeilingError:
                return
            if self._arena.steps > self._most - self._reserved(after):
                return
            self._found = after
            self._note()
            took = monotonic() - begin
            self._settings.advance(took, self._text())

    def _reserved(self, found: Search) -> int:
        """The steps that the last validation may take."""
        agents, seeds = found.last_validation()
        episodes = len(agents) * len(seeds) if len(agents) > 1 else 0
        return episodes * self._probe.most_steps

    def _is_over(self, took: float) -> bool:
        """Whether there is no time for another round like the last one, or nothing left to do."""
        found, settings = self._found, self._settings
        if found.is_over or found.rounds >= (settings.rounds or np.inf):
            return True
        if not self._is_enough and found.is_tuned and found.baseline is None:
            return True
        done, seconds = self._arena.steps - self._steps_before, monotonic() - self._begin
        pace = seconds / done if done else self._probe.seconds
        return seconds + took + self._reserved(found) * pace >= settings.seconds

    def _text(self) -> str:
        """The scores, for a line of progress."""
        found = self._found
        best = f", best {found.merit[1]:.6g}" if found.best else ""
        base = f", {found.baseline.name} {found.merit_of_baseline[1]:.6g}" if found.baseline else ""
        return f"round {found.rounds}{best}{base}"

    def _note(self) -> None:
        """Write down an agent that is better than the baseline and all before."""
        found = self._found
        if found.baseline is None or found.best is None or found.merit <= self._noted:
            return
        self._noted = found.merit
        path = self._settings.folder / EVALUATIONS
        if not path.exists():
            path.write_text("steps,reward,baseline\n", encoding="utf-8")
        with path.open("a", encoding="utf-8") as file:
            file.write(f"{self._arena.steps},{found.merit[1]},{found.merit_of_baseline[1]}\n")
        self._save(found.best)

    def _save(self, agent: Agent, **more: Any) -> dict[str, Any]:
        """Write an agent, its facts, and the state of the search."""
        folder, found, task = self._settings.folder, self._found, self._probe.task
        replace(agent, names=task["observations"], actions=task["actions"]).save(folder)
        facts = {
            "algorithm": "search",
            "agent": agent.name,
            "baseline": (found.baseline or agent).name,
            "controller": agent.text,
            "rounds": found.rounds,
            "seed": found.seed,
            "steps": self._arena.steps,
            **more,
        }
        (folder / FACTS).write_text(json.dumps(facts), encoding="utf-8")
        part = folder / f"{STATE}.part"
        part.write_bytes(pickle.dumps((found, self._probe, self._arena.steps)))
        part.replace(folder / STATE)
        return facts

    def judged(self, winner: Agent) -> tuple[Verdict, dict[str, Any]]:
        """Let the winner play beside the others, and write what it has reached."""
        settings, probe, found = self._settings, self._probe, self._found
        if winner is found.baseline:
            settings.tell(
                f"nothing was found that beats {winner.name}: the folder has that controller"
            )
        agents = {winner.name: winner}
        count = 1 if probe.is_same else settings.episodes
        baseline = found.baseline or winner
        for other in [baseline, *found.others(), *self._planners(baseline.text, count)]:
            agents.setdefault(other.name, other)
        arenas = {
            name: self._arena_of(make, probe.most_steps if make is settings.make_env else _LONGEST)
            for name, make in settings.scenarios.items()
        }
        verdict = judge(agents, arenas, probe.limits, count)
        return verdict, self._save(winner, test=verdict.as_dict())

    def _planners(self, baseline: str | None, episodes: int | None) -> Iterator[Agent]:
        """The controllers that plan ahead and whose test takes no longer than the search.

        They begin with the plan of the baseline.
        """
        declared = self._probe.task.get("controllers", {})
        for name, text in declared.items():
            if plans_ahead(text):
                warm = warmed(text, baseline)
                minutes = self._minutes_of_test(warm, episodes)
                if minutes <= (self._settings.minutes or _MINUTES):
                    yield Agent(name, warm)
                else:
                    self._settings.tell(
                        f"left out: {name}, whose test would take about {minutes:.0f} min; "
                        "'fmugym evaluate' compares it with the agent"
                    )

    def _minutes_of_test(self, text: str, episodes: int | None) -> float:
        """How long a controller would take for the test, by the time of its second decision."""
        steps = 0
        for make_env in self._settings.scenarios.values():
            with closing(make_env()) as env:
                steps += env.config.max_episode_steps or self._probe.most_steps
        with closing(self._settings.make_env()) as env:
            controller = controller_of(text).bind(env)
            observation, _ = env.reset(seed=self._settings.seed)
            observation, *_ = env.step(controller.act(observation))
            begin = monotonic()
            controller.act(observation)
            took = monotonic() - begin
        return took * steps * episodes_of(len(self._settings.scenarios), episodes) / 60.0


def _resumed(settings: SearchSettings) -> _Course:
    """Read the state of a search; it is a pickle, which can run code.

    Raises:
        ConfigError: If there is none, it is damaged, or it is of another task.
    """
    folder = settings.folder
    try:
        found, probe, steps = pickle.loads((folder / STATE).read_bytes())
        before = probe.task
    except FileNotFoundError:
        raise ConfigError(f"{shown(str(folder))} has no search to resume") from None
    except ordinary(Exception) as error:  # a damaged file may raise anything
        raise ConfigError(
            f"the search in {shown(str(folder))} cannot be resumed: {reason(error)}"
        ) from None
    with closing(settings.make_env()) as env:
        now = task_of(env)
    changed = [key for key in {**before, **now} if before.get(key) != now.get(key)]
    if changed:
        raise ConfigError(
            f"the search in {shown(str(folder))} is of a task that differs in {', '.join(changed)}"
        )
    return found, probe, steps
