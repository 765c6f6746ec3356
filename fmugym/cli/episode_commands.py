"""Commands that play episodes: ``simulate``, ``evaluate``, ``bench``.

``bench`` measures the speed of a task: steps per second of one environment and of many, and the
FMU's share.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Final

import numpy as np
from gymnasium.vector import AutoresetMode

from fmugym.checks import Spellings, check_number
from fmugym.cli.minari_datasets import (
    add_of_datasets,
    add_timezone,
    dataset_of,
    make_dataset,
    read_log,
)
from fmugym.cli.options import (
    Commands,
    add_command,
    add_episodes,
    add_json,
    add_players,
    add_task,
    check_counts,
    output_of,
    players_of,
    say,
    say_json,
    say_result,
    shown_in_any_case,
    tell,
    watched,
)
from fmugym.cli.plant_commands import (
    add_of_plants,
    check_plant_options,
    evaluate_log,
    follow_plant,
    plant_task,
)
from fmugym.cli.task_arguments import maker_of, player_maker, scenarios_of
from fmugym.control.candidate_evaluation import most_steps_of
from fmugym.environment.env import FMUEnv
from fmugym.environment.vector import FMUVectorEnv
from fmugym.errors import ConfigError, FMUGymError, plain, reason
from fmugym.records.evaluation import Score, evaluate, plot_scores, table
from fmugym.records.output_files import EpisodeFiles, require_format, require_picture, title_of
from fmugym.records.players import Player, Summary, simulate

__all__ = [
    "Speed",
    "SpeedReport",
    "add_bench",
    "add_evaluate",
    "add_simulate",
    "bench",
    "speed_table",
]

_ROUNDS: Final = 5
"""Number of measurements, the fastest of which counts: other load only makes them slower."""

_CAUTION: Final = (
    "Measured on this machine as it is now. Close other programs, measure several times, and "
    "compare\nonly what was measured together: a busy machine or a slower clock halves these "
    "figures."
)


@dataclass(frozen=True)
class Speed:
    """The speed of environments that step together.

    Attributes:
        envs: How many; 0 stands for a single environment without vectors.
        hooks: Calls of the hooks.
        steps_per_second: Steps per second of all environments together, resets included.
        microseconds: Real time of one call of ``step``.
        fmu_share: The part of it that the FMUs take by themselves; None if it cannot be measured.
    """

    envs: int
    hooks: str
    steps_per_second: float
    microseconds: float
    fmu_share: float | None


@dataclass(frozen=True)
class SpeedReport:
    """The result of a measurement.

    Attributes:
        speeds: Speeds of a single environment, and of vector environments.
        time_step: The simulated seconds in a step.
        processors: How many this process may use.
        load: The mean number of running programs in the last minute; None if it is not known.
    """

    speeds: tuple[Speed, ...]
    time_step: float
    processors: int
    load: float | None


def bench(
    make_env: Callable[[], FMUEnv], sizes: Iterable[int], seconds: float
) -> Iterator[SpeedReport]:
    """Measure the speed of a task with random actions.

    Args:
        make_env: A function that makes the environment.
        sizes: The sizes of vector environments.
        seconds: Real time of each measurement.

    Yields:
        After each measurement a report with all speeds until then.

    Raises:
        ConfigError: If ``seconds`` is not positive and finite.
        FMUGymError: If an environment cannot be made, or fails.
    """
    check_number("--seconds", seconds, positive=True)
    load: float | None = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    with closing(make_env()) as env:
        time_step = env.pool_spec.time_step
        report = SpeedReport((_of_single(env, seconds),), time_step, _processors(), load)
    yield report
    for size in sizes:
        report = replace(report, speeds=(*report.speeds, _of_vector(make_env, size, seconds)))
        yield report


def _processors() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return os.cpu_count() or 1 if affinity is None else len(affinity(0))


def _of_single(env: FMUEnv, seconds: float) -> Speed:
    actions = [env.action_space.sample() for _ in range(64)]

    def step(number: int) -> None:
        result = env.step(actions[number % 64])
        if result[2] or result[3]:
            env.reset()

    env.reset(seed=0)
    _fastest(step, seconds / 4)
    took = _fastest(step, seconds)
    hooks = "expressions" if env.is_compiled else "Python"
    env.reset(seed=0)
    return Speed(0, hooks, 1.0 / took, took * 1e6, _share(env, seconds, took))


def _of_vector(make_env: Callable[[], FMUEnv], size: int, seconds: float) -> Speed:
    with closing(FMUVectorEnv(make_env, size, autoreset_mode=AutoresetMode.SAME_STEP)) as envs:
        envs.reset(seed=0)
        actions = [envs.action_space.sample() for _ in range(16)]
        took = _fastest(lambda number: envs.step(actions[number % 16]), seconds)
        envs.reset(seed=0)
        share = _share(envs.prototype, seconds, took)
        return Speed(size, envs.task.way, size / took, took * 1e6, share)


def _fastest(step: Callable[[int], Any], seconds: float) -> float:
    """The seconds of a call, in the fastest of some rounds."""
    count, number, best = _count(step, seconds / _ROUNDS), 0, float("inf")
    for _ in range(_ROUNDS):
        begin = perf_counter()
        for _ in range(count):
            step(number)
            number += 1
        best = min(best, (perf_counter() - begin) / count)
    return best


def _count(step: Callable[[int], Any], seconds: float) -> int:
    """Estimated number of calls in a time."""
    count = 1
    while True:
        begin = perf_counter()
        for number in range(count):
            step(number)
        took = perf_counter() - begin
        if took > seconds / 4 or count >= 1_000_000:
            return max(1, round(count * seconds / max(took, 1e-9)))
        count *= 2


def _share(env: FMUEnv, seconds: float, took: float) -> float | None:
    """The part of a step that the pool takes for the FMUs alone, without hooks and resets.

    The FMUs go on from the beginning of an episode with their first inputs, for as many steps as an
    episode may have, so that they stay near states that occur.
    """
    pool = env.pool
    variables = tuple(env.episode_start.model_variables)
    rng = np.random.default_rng(0)
    limit = min(env.step_limit, 1000)
    best = float("inf")
    end = perf_counter() + seconds / 2
    try:
        while perf_counter() < end:
            pool.reset(variables, env.episode_start.draw_starts(rng, pool.num_instances))
            begin = perf_counter()
            for _ in range(limit):
                pool.step(None)
            best = min(best, (perf_counter() - begin) / limit)
    except FMUGymError:
        return None
    return min(1.0, best / took)


def speed_table(report: SpeedReport) -> str:
    """Format speeds for a terminal."""
    header = ("environments", "hooks", "steps/s", "us per call", "FMU's share", "x real time")
    rows = [header, *(_row(speed, report.time_step) for speed in report.speeds)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
    lines = [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    ]
    load = "" if report.load is None else f", {report.load:.2g} programs were running before"
    return "\n".join([*lines, "", f"{report.processors} processors{load}", _CAUTION])


def _row(speed: Speed, time_step: float) -> tuple[str, ...]:
    return (
        str(speed.envs) if speed.envs else "single",
        speed.hooks,
        f"{speed.steps_per_second:,.0f}",
        f"{speed.microseconds:.4g}",
        "" if speed.fmu_share is None else f"{100 * speed.fmu_share:.0f} %",
        f"{speed.steps_per_second * time_step:.3g}",
    )


def add_simulate(commands: Commands) -> None:
    """Add ``simulate``."""
    text = "play episodes, and write them to tables, pictures, reports or datasets"
    command = add_command(commands, "simulate", _simulate, text)
    add_task(command)
    add_players(command)
    command.add_argument("--scenario", help="a scenario of the task file")
    add_episodes(command, 1, 0)
    command.add_argument(
        "--output",
        type=output_of,
        action="append",
        default=[],
        metavar="FILE",
        help="a new file: .csv, .parquet, .html (a report), .png, .svg or .pdf, more than once "
        "for several; or minari:NAME for a dataset",
    )
    command.add_argument(
        "--variables", action="append", metavar="GLOB", help="by default all names of the task"
    )
    command.add_argument("--every", type=float, metavar="SECONDS", help="between rows")
    add_of_datasets(command)
    add_of_plants(command)
    add_json(command)


def _simulate(arguments: argparse.Namespace) -> int:
    check_counts(arguments, "episodes", "steps")
    check_plant_options(arguments)
    if dataset_of(arguments) is not None:
        make_dataset(arguments)
        return 0
    if arguments.plant is not None:
        for path in arguments.output:
            require_format(path, 1)
        follow_plant(arguments)
        return 0
    players = players_of(arguments)
    for path in arguments.output:
        require_format(path, len(players))
    recording = EpisodeFiles(arguments.task, arguments.scenario, arguments.output)
    runs: dict[str, list[Summary]] = {name: [] for name in players}

    def show() -> None:
        if arguments.json:
            told = {name: [one.as_dict() for one in found] for name, found in runs.items()}
            only = {"episodes": next(iter(told.values()))} if len(told) == 1 else {}
            say_json({"task": arguments.task, "output": arguments.output, "runs": told, **only})

    left_out = LeftOut(players)
    for name, player in players.items() if len(players) > 1 else ():
        with left_out.noting(name), closing(player.make_env(_maker(arguments))) as env:
            player.make_policy(env)  # so that no mistake comes up after another has played
    left_out.require_some()
    with shown_in_any_case(show), recording.finished(arguments.seed):
        for name, player in players.items():
            if name not in left_out.errors:
                with left_out.noting(name):
                    _play(arguments, recording, name, player, runs)
        left_out.require_some()
    is_nothing = any(one.has_no_reward for found in runs.values() for one in found)
    return left_out.code or int(is_nothing)


def _maker(arguments: argparse.Namespace) -> Callable[[], FMUEnv]:
    return player_maker(arguments.task, arguments.scenario, arguments.master)


def _play(
    arguments: argparse.Namespace,
    recording: EpisodeFiles,
    name: str,
    player: Player,
    runs: dict[str, list[Summary]],
) -> None:
    """Play the episodes of a player."""
    label = f"{name}: " if len(runs) > 1 else ""
    with (
        closing(player.make_env(_maker(arguments))) as env,
        watched(_steps_of(env, arguments), name, "steps") as advance,
    ):
        policy = player.make_policy(env)
        played: Any = env
        if arguments.output:
            played = recording.begin(name, env, arguments.variables, arguments.every)
        for seed in range(arguments.seed, arguments.seed + arguments.episodes):
            runs[name].append(simulate(played, policy, seed, arguments.steps, advance))
            if not arguments.json:
                say(plain(f"{label}{runs[name][-1].as_text()}"))


def _steps_of(env: FMUEnv, arguments: argparse.Namespace) -> int | None:
    """Most steps of the episodes; None if only ``--steps`` limits them."""
    limit = most_steps_of(env)
    return None if limit is None else min(limit, arguments.steps) * int(arguments.episodes)


def add_evaluate(commands: Commands) -> None:
    """Add ``evaluate``."""
    text = "let agents, controllers, random and constant actions play the same episodes"
    command = add_command(commands, "evaluate", _evaluate, text)
    add_task(command)
    add_players(command)
    command.add_argument(
        "--scenario",
        action="append",
        help="a scenario of the task file, or 'all'; more than once for several",
    )
    add_episodes(command, 10, 1_000_000)
    command.add_argument(
        "--log",
        metavar="FILE",
        help="the record of a shadow (.csv): what the plant has reached, and what others reach on "
        "the FMU in the same periods",
    )
    add_timezone(command)
    command.add_argument(
        "--plot", type=Path, metavar="FILE", help="a new picture of the rewards and costs"
    )
    add_json(command)


def _evaluate(arguments: argparse.Namespace) -> int:
    check_counts(arguments, "episodes", "steps")
    if arguments.plot is not None:
        require_picture(arguments.plot)
    if arguments.log is not None and arguments.scenario:
        raise ConfigError("--log has its own periods: leave --scenario out")
    players = players_of(arguments, random=arguments.log is None)
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    scores: list[Score] = []
    left_out = LeftOut(players)

    def leave_out(name: str, error: Exception) -> None:
        left_out.note(name, error)
        if not scores:  # nobody has played
            left_out.require_some()

    with shown_in_any_case(lambda: _show_scores(scores, arguments)):
        if arguments.log is not None:
            task, log = plant_task(arguments), read_log(arguments.log, arguments)
            with watched(1.0, "evaluate") as advance:
                scores.extend(evaluate_log(task, log, players, advance, leave_out))
        else:
            scenarios = _scenarios(arguments)
            total = len(scenarios) * len(players) * arguments.episodes
            with watched(total, "evaluate") as advance:
                for scenario in scenarios:
                    make_env = player_maker(arguments.task, scenario, arguments.master)
                    more = scenario, advance
                    played = evaluate(
                        make_env, players, seeds, arguments.steps, *more, leave_out=leave_out
                    )
                    scores.extend(played)  # one by one, so that an interruption keeps them
    left_out.require_some()
    return left_out.code


class LeftOut:
    """Players that failed and are left out, while the others play on.

    Args:
        players: All who shall play, by name.

    Attributes:
        errors: Why, by the names of those who are left out.
    """

    def __init__(self, players: Iterable[str]) -> None:
        self._names = [*players]
        self.errors: dict[str, Exception] = {}

    def note(self, name: str, error: Exception) -> None:
        """Leave one out, and say why, if others are there."""
        self.errors[name] = error
        if self._asked != [name]:
            tell(f"left out: {name}: {reason(error)}", is_needed=True)

    @contextmanager
    def noting(self, name: str) -> Iterator[None]:
        """Leave out a player if a block fails."""
        try:
            yield
        except Exception as error:
            self.note(name, error)

    @property
    def _asked(self) -> list[str]:
        """Players that the user asked for; random actions always play."""
        return [name for name in self._names if name != "random"] or self._names

    def require_some(self) -> None:
        """Raise the first error if no player is left that the user asked for."""
        if all(name in self.errors for name in self._asked):
            raise self.errors[self._asked[0]]

    @property
    def code(self) -> int:
        """The exit code."""
        return 1 if self.errors else 0


def _show_scores(scores: list[Score], arguments: argparse.Namespace) -> None:
    if not scores:
        return
    if arguments.plot is not None:
        plot_scores(scores, arguments.plot, title_of(arguments.task))
    say_result(arguments, {"scores": [one.as_dict() for one in scores]}, table(scores))


def _scenarios(arguments: argparse.Namespace) -> list[str | None]:
    """The scenarios to play, by their names in the task; None for the episodes of the task."""
    names: list[str] = arguments.scenario or []
    known = scenarios_of(arguments.task) if names else []
    if names == ["all"]:
        return list(known) or [None]
    spellings = Spellings("scenario", known)
    return list(dict.fromkeys(spellings.find(name) or name for name in names)) or [None]


def add_bench(commands: Commands) -> None:
    """Add ``bench``."""
    text = "measure steps per second: one environment, many, and the FMU's share"
    command = add_command(commands, "bench", _bench, text)
    add_task(command, ", or an FMU")
    command.add_argument(
        "--envs",
        type=int,
        action="append",
        metavar="N",
        help="the size of a vector environment; more than once for several; default 8, 64, 1024",
    )
    command.add_argument(
        "--seconds", type=float, default=1.0, help="of each measurement; default 1"
    )
    add_json(command)


def _bench(arguments: argparse.Namespace) -> None:
    reports: list[SpeedReport] = []

    def show() -> None:
        for last in reports[-1:]:  # which has the speeds of those before
            say_result(arguments, asdict(last), speed_table(last))

    with shown_in_any_case(show):
        make = maker_of(arguments.task, master=arguments.master, takes_fmu=True)
        reports.extend(bench(make, arguments.envs or [8, 64, 1024], arguments.seconds))
