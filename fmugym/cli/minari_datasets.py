"""Datasets of Minari, made by ``simulate`` and read by ``info``."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

from fmugym.cli.options import MINARI, only_player, say_result
from fmugym.cli.task_arguments import maker_of
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.extras import imported
from fmugym.records.plant_log import PlantLog, as_logged, play_log
from fmugym.records.players import Player, simulate
from fmugym.records.progress_bars import progress_bar
from fmugym.records.recording import Recorder, Recording
from fmugym.task import Task, load
from fmugym.task.data_rows import standard_time

__all__ = [
    "add_of_datasets",
    "add_timezone",
    "dataset_of",
    "make_dataset",
    "read_log",
    "renaming",
    "show_dataset",
]

_OPTIONS: Final = ("log", "column", "timezone", "tolerance", "author", "description")


def add_of_datasets(command: argparse.ArgumentParser) -> None:
    """Add the options for ``--output minari:NAME``."""
    group = command.add_argument_group("with --output minari:NAME (needs the extra minari)")
    group.add_argument(
        "--log",
        action="append",
        metavar="FILE",
        help="instead of who acts: a log of a plant (.csv) or a recording (.npz); more than once",
    )
    group.add_argument(
        "--column",
        action="append",
        metavar="COLUMN=VARIABLE",
        help="a column of the log whose name is not that of the variable; more than once",
    )
    add_timezone(group)
    group.add_argument(
        "--tolerance",
        type=float,
        help="how far an input may be from that of the log, as a part of its range; default 0.001",
    )
    group.add_argument("--author", help="for the dataset's metadata")
    group.add_argument("--description", help="for the dataset's metadata")


def add_timezone(command: Any) -> None:
    """Add the option for logs with dates."""
    command.add_argument(
        "--timezone",
        metavar="ZONE",
        help="the zone of dates without an offset in a log, such as Europe/Berlin or +01:00",
    )


def read_log(path: str, arguments: argparse.Namespace) -> PlantLog:
    """Read a log, whose dates are then on the standard time of the task.

    Raises:
        ConfigError: If the log or the task has a mistake.
    """
    has_file = str(arguments.task).lower().endswith(".toml")
    standard = standard_time(Task.read(arguments.task).root).offset if has_file else None
    return PlantLog.read(path, timezone=arguments.timezone, standard=standard)


def dataset_of(arguments: argparse.Namespace) -> str | None:
    """The name of the dataset to be made; None if files are written.

    Raises:
        ConfigError: If it is written beside files, or options are for datasets only.
    """
    names = [str(one) for one in arguments.output if not isinstance(one, Path)]
    given = [name for name in _OPTIONS if getattr(arguments, name) is not None]
    if not names and given:
        raise ConfigError(f"--{given[0]} is for datasets: --output {MINARI}NAME")
    if names and len(arguments.output) > 1:
        raise ConfigError(f"a dataset is written alone, got {len(arguments.output)} outputs")
    return names[0].removeprefix(MINARI) if names else None


def make_dataset(arguments: argparse.Namespace) -> None:
    """Make a dataset of episodes, recordings or logs of a plant."""
    datasets = imported("fmugym.records.minari", "minari")
    name = dataset_of(arguments)
    make_env = maker_of(arguments.task, arguments.scenario, arguments.master)
    if arguments.log:
        recordings, make_env = _logged(arguments, make_env)
    else:
        player = only_player(arguments)
        make_env = partial(player.make_env, make_env)
        recordings = _played(arguments, make_env, player)
    about = {"author": arguments.author, "description": arguments.description}
    with closing(make_env()) as env:
        datasets.write_dataset(name, recordings, env, replaces=arguments.force, **about)
    _show(arguments, str(name), recordings, f"dataset {name}")


def show_dataset(arguments: argparse.Namespace, name: str) -> None:
    """Describe a dataset, and write its recordings to a folder if one is given."""
    recordings = imported("fmugym.records.minari", "minari").read_dataset(name)
    what, folder = f"dataset {name}", arguments.output
    if folder is not None:
        folder.mkdir(parents=True)
        for number, recording in enumerate(recordings):
            recording.save(folder / f"episode-{number:04}.npz")
        what = f"{len(recordings)} recordings in {folder}"
    _show(arguments, name, recordings, what)


def _logged(
    arguments: argparse.Namespace, make_env: Callable[..., FMUEnv]
) -> tuple[list[Recording], Callable[..., FMUEnv]]:
    """Read the episodes of logs, and make an environment for their time."""
    columns = dict(map(renaming, arguments.column or []))
    tolerance = 1e-3 if arguments.tolerance is None else arguments.tolerance
    found, make = list[Recording](), make_env
    for path in arguments.log:
        if path.endswith(".npz"):
            found.append(Recording.load(path))
            continue
        log, seed, make = read_log(path, arguments), arguments.seed + len(found), make_env
        if log.proposed is not None:  # of the shadow of a plant, so in seconds of the year
            if arguments.scenario is not None:
                raise ConfigError(f"{shown(path)} has its own periods: leave --scenario out")
            make = partial(load, as_logged(Task.read(arguments.task), log))
        found += play_log(log, make, columns=columns, tolerance=tolerance, seed=seed)
    return found, make


def renaming(text: str) -> tuple[str, str]:
    """Split ``COLUMN=VARIABLE``.

    Raises:
        ConfigError: If it is something else.
    """
    column, separator, variable = text.rpartition("=")
    if not separator:
        raise ConfigError(f"expected COLUMN=VARIABLE, got {shown(text)}")
    return column, variable


def _played(
    arguments: argparse.Namespace, make_env: Callable[[], FMUEnv], player: Player
) -> list[Recording]:
    with closing(make_env()) as env, progress_bar(None, "dataset") as advance:
        recorder, policy = Recorder(env), player.make_policy(env)
        found: list[Recording] = []
        for seed in range(arguments.seed, arguments.seed + arguments.episodes):
            simulate(recorder, policy, seed, arguments.steps, advance)
            found.append(recorder.recording)
            found[-1].truncated[-1] |= not found[-1].terminated[-1]
    return found


def _show(
    arguments: argparse.Namespace, name: str, recordings: Sequence[Recording], what: str
) -> None:
    count, steps = len(recordings), sum(map(len, recordings))
    rewards = [float(one.rewards.sum()) for one in recordings]
    facts = {"dataset": name, "episodes": count, "steps": steps, "rewards": rewards}
    say_result(arguments, facts, f"{what}: {count} episodes, {steps} steps")
