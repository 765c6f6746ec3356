"""The command that makes datasets of episodes: dataset."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.extras import imported
from fmugym.logs import PlantLog, play_log
from fmugym.recording import Recorder, Recording
from fmugym.tools.options import (
    HELP_OF_TASK,
    Commands,
    add_command,
    add_episodes,
    add_json,
    add_master,
    add_players,
    check_numbers,
    only_player,
    say,
    say_json,
)
from fmugym.tools.progress import progress
from fmugym.tools.simulation import Player, simulate
from fmugym.tools.targets import maker_of

__all__ = ["add_dataset"]

MakeEnv = Callable[[], FMUEnv]


def add_dataset(commands: Commands) -> None:
    """Add ``dataset``."""
    text = "make a dataset of Minari from episodes, recordings or logs of a plant; or read one"
    command = add_command(commands, "dataset", _dataset, text)
    command.add_argument("name", metavar="NAME", help="of the dataset, such as house/pi-v0")
    command.add_argument("--task", metavar="TASK", help=HELP_OF_TASK)
    add_master(command)
    sources = command.add_mutually_exclusive_group()
    sources.add_argument(
        "--log", action="append", metavar="FILE", help="a CSV file of a plant; more than once"
    )
    sources.add_argument(
        "--recording", action="append", metavar="FILE", help="a recording (.npz); more than once"
    )
    sources.add_argument(
        "--output", type=Path, metavar="FOLDER", help="write the dataset as recordings (.npz) here"
    )
    command.add_argument(
        "--column",
        action="append",
        default=[],
        metavar="COLUMN=VARIABLE",
        help="a column of the log whose name is not that of the variable; more than once",
    )
    command.add_argument(
        "--tolerance",
        type=float,
        default=1e-3,
        help="how far an input may be from that of the log, as a part of its range",
    )
    command.add_argument("--author", help="for the dataset's metadata")
    command.add_argument("--description", help="for the dataset's metadata")
    add_players(command)
    command.add_argument("--scenario", help="a scenario of the task file")
    add_episodes(command, 10, 0)
    add_json(command)


def _dataset(arguments: argparse.Namespace) -> None:
    datasets = imported("fmugym.minari", "minari")
    if arguments.output is not None:
        recordings = datasets.read_dataset(arguments.name)
        files = _write(recordings, arguments.output)
        _show(arguments, recordings, f"{len(files)} recordings in {arguments.output}")
        return
    if arguments.task is None:
        raise ConfigError("a new dataset needs --task; --output FOLDER reads an existing one")
    is_played = not (arguments.recording or arguments.log)
    player = only_player(arguments) if is_played else None
    make_env: MakeEnv = maker_of(arguments.task, arguments.scenario, arguments.master)
    if player is not None:
        make_env = partial(player.make_env, make_env)
    recordings = _recordings(arguments, make_env, player)
    about = {"author": arguments.author, "description": arguments.description}
    with closing(make_env()) as env:
        datasets.write_dataset(arguments.name, recordings, env, **about)
    _show(arguments, recordings, f"dataset {arguments.name}")


def _recordings(
    arguments: argparse.Namespace, make_env: MakeEnv, player: Player | None
) -> list[Recording]:
    """The episodes that the arguments name; those of a player if there is one."""
    if player is not None:
        return _played(arguments, make_env, player)
    if arguments.log:
        return _logged(arguments, make_env)
    return [Recording.load(path) for path in arguments.recording]


def _logged(arguments: argparse.Namespace, make_env: MakeEnv) -> list[Recording]:
    columns = dict(map(_renaming, arguments.column))
    found: list[Recording] = []
    for path in arguments.log:
        log = PlantLog.read(path)
        seed = arguments.seed + len(found)
        found += play_log(log, make_env, columns=columns, tolerance=arguments.tolerance, seed=seed)
    return found


def _renaming(text: str) -> tuple[str, str]:
    column, separator, variable = text.rpartition("=")
    if not separator:
        raise ConfigError(f"expected COLUMN=VARIABLE, got {shown(text)}")
    return column, variable


def _played(arguments: argparse.Namespace, make_env: MakeEnv, player: Player) -> list[Recording]:
    check_numbers(arguments, "episodes", "steps")
    with closing(make_env()) as env, progress(None, "dataset") as advance:
        recorder, policy = Recorder(env), player.make_policy(env)
        found: list[Recording] = []
        for seed in range(arguments.seed, arguments.seed + arguments.episodes):
            simulate(recorder, policy, seed, arguments.steps, advance)
            found.append(recorder.recording)
            found[-1].truncated[-1] |= not found[-1].terminated[-1]
    return found


def _write(recordings: Sequence[Recording], folder: Path) -> list[Path]:
    folder.mkdir(parents=True)
    files = [folder / f"episode-{number:04}.npz" for number in range(len(recordings))]
    for recording, file in zip(recordings, files, strict=True):
        recording.save(file)
    return files


def _show(arguments: argparse.Namespace, recordings: Sequence[Recording], what: str) -> None:
    steps = sum(map(len, recordings))
    if arguments.json:
        rewards = [float(one.rewards.sum()) for one in recordings]
        say_json(
            {
                "dataset": arguments.name,
                "episodes": len(recordings),
                "steps": steps,
                "rewards": rewards,
            }
        )
        return
    say(f"{what}: {len(recordings)} episodes, {steps} steps")
