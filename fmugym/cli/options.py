"""Options that commands share, players among them, and their output: results, notes, progress.

The progress of a command is a bar in a terminal, otherwise a line now and then.
"""

from __future__ import annotations

import argparse
import codecs
import json
import logging
import os
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Final

from fmugym.checks import check_count, check_seed
from fmugym.errors import ConfigError, plain, shown
from fmugym.fmi.systems.system_plan import MASTERS
from fmugym.records.players import Player, action_of, policy_of
from fmugym.records.progress_bars import Advance, no_progress, progress_bar, quiet
from fmugym.task.task_writer import as_toml, write_new
from fmugym.training.agents import AGENT_FILE, agent_player

__all__ = [
    "HELP_OF_TASK",
    "MINARI",
    "Commands",
    "add_command",
    "add_common",
    "add_episodes",
    "add_json",
    "add_master",
    "add_players",
    "add_task",
    "check_counts",
    "free_outputs",
    "only_player",
    "output_of",
    "players_of",
    "print_note",
    "require_toml",
    "say",
    "say_json",
    "say_result",
    "shown_in_any_case",
    "speaking",
    "tell",
    "watched",
    "write_extension",
    "write_text",
]

Commands = Any
"""The object that ``ArgumentParser.add_subparsers`` returns."""

HELP_OF_TASK: Final = "a task file, a registered id or module:Class"
_CONTROLLER: Final = "a controller and its arguments: 'pid of=T setpoint=21 kp=0.5 ti=14400'"
_ACTION: Final = "random, or the numbers of one action: 0.5,-1"
_OF_ONE_KIND: Final = 3
MINARI: Final = "minari:"
"""Beginning of the name of a Minari dataset, where files or FMUs may be named, too."""

_FILES: Final = ("output", "plot")
"""Options that name files or folders to write."""

_OF_TRAININGS: Final = ("agent.json", "evaluations.csv", "search.npz", "training.json")
"""Files that mark the folder of a training, which ``--force`` replaces."""

EXAMPLES: Final = {
    "info": (
        "fmugym info model.fmu",
        "fmugym info --filter 'theta*' model.fmu",
        "fmugym info system.ssp",
        "fmugym info --repair model.fmu",
        "fmugym info minari:swing/random-v0 --output episodes",
    ),
    "new": (
        "fmugym new model.fmu --output task.toml",
        "fmugym new --class model.fmu --output my_env.py",
    ),
    "validate": ("fmugym validate task.toml", "fmugym validate fmugym/Pendulum-v0 --json"),
    "simulate": (
        "fmugym simulate task.toml --action 0.01 --episodes 2 --seed 3",
        "fmugym simulate task.toml --output run.csv --variables 'q*' --variables tau --every 0.1",
        "fmugym simulate fmugym/House-v0 --scenario frost "
        "--controller 'pid of=T setpoint=21 kp=0.5 ti=14400' --steps 96 --output frost.html",
        "fmugym simulate house.toml --output minari:house/measured-v0 --log week.csv "
        "--column pump_speed=u",
        "fmugym simulate house.toml --plant --agent agent --ahead 6h --output shadow.csv",
    ),
    "train": (
        "fmugym train examples/cart_pole.toml --output agent --minutes 0.1",
        "fmugym train examples/cart_pole.toml --output agent --minutes 0.1 --resume",
    ),
    "tune": (
        'fmugym tune task.toml "pid of=q setpoint=1 kp=0.01..1 td=0..1" --rounds 3 --steps 100 '
        "--output tuned.toml",
    ),
    "fit": (
        "fmugym fit task.toml --log plant.csv --parameter l=0.05..0.2 --parameter b --start q_0 "
        "--output fitted.toml",
    ),
    "export": ("fmugym export trained --task examples/cart_pole.toml --output agent.c",),
    "serve": ("fmugym serve house.toml --controller thermostat --speed 9000 --steps 50",),
    "evaluate": ("fmugym evaluate examples/cart_pole.toml --agent agent --action 10",),
    "bench": ("fmugym bench task.toml --seconds 0.1",),
}
"""Examples in ``--help`` of each command; a test finds these lines in the documents."""

_JSON_VERSION: Final = 1
"""Version of the JSON; raised when a key goes or changes its meaning."""


def add_command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int | None],
    text: str,
) -> argparse.ArgumentParser:
    """Add a command that calls a function with the arguments."""
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        help=text,
        description=f"{text[0].upper()}{text[1:]}.",
        epilog="\n  ".join(["examples:", *EXAMPLES[name]]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=run)
    return command


def add_common(command: argparse.ArgumentParser) -> None:
    """Add the options of all commands, and ``--force`` for a command that writes files."""
    group = command.add_mutually_exclusive_group()
    group.add_argument("-q", "--quiet", action="store_true", help="print results and errors only")
    group.add_argument(
        "-v",
        "--verbose",
        action="store_true",
        help="show the log, and what FMUs print; with info: all parameters and findings",
    )
    files = [one.dest for one in command._actions if one.dest in _FILES]
    command.set_defaults(files=files)
    if files:
        command.add_argument("--force", action="store_true", help="replace what exists")


def add_json(command: argparse.ArgumentParser) -> None:
    """Add the option for results that programs read."""
    command.add_argument("--json", action="store_true", help="print one JSON object")


def add_task(command: argparse.ArgumentParser, also: str = "") -> None:
    """Add the argument for the task."""
    command.add_argument("task", metavar="TASK", help=HELP_OF_TASK + also)
    add_master(command)


def add_master(command: argparse.ArgumentParser) -> None:
    """Add the option for the master of systems."""
    text = "how a system exchanges values, in the place of what its SSP archive or task says"
    command.add_argument("--master", choices=MASTERS, help=text)


def add_episodes(command: argparse.ArgumentParser, episodes: int, seed: int) -> None:
    """Add the options for which episodes are played."""
    command.add_argument(
        "--episodes",
        type=int,
        default=episodes,
        metavar="N",
        help=f"how many to play; default {episodes}",
    )
    command.add_argument(
        "--seed",
        type=int,
        default=seed,
        metavar="N",
        help=f"of the first episode, the next have the next; default {seed}",
    )
    command.add_argument(
        "--steps",
        type=int,
        default=10_000,
        metavar="N",
        help="the most steps of an episode; default 10000",
    )


def add_players(command: argparse.ArgumentParser) -> None:
    """Add the options for players, each of which may be given several times."""
    command.add_argument("--action", action="append", default=[], metavar="TEXT", help=_ACTION)
    command.add_argument(
        "--controller", action="append", default=[], metavar="TEXT", help=_CONTROLLER
    )
    command.add_argument(
        "--agent",
        type=Path,
        action="append",
        default=[],
        metavar="FOLDER",
        help="the folder of an agent, which 'fmugym train' has written",
    )


def players_of(arguments: argparse.Namespace, *, random: bool = False) -> dict[str, Player]:
    """Make players by name, from the options of ``add_players``.

    Args:
        arguments: Arguments of the command line.
        random: Whether random actions are among them in any case. They are if nobody else is.

    Raises:
        ConfigError: If there is no such agent.
    """
    given = arguments.action + arguments.controller + arguments.agent
    actions = ["random", *arguments.action] if random or not given else arguments.action
    players: dict[str, Player] = {}
    for text in actions:
        is_random, make_policy = text == "random", partial(action_of, text=text)
        name = text if is_random else f"action {text}"
        players[name] = Player(make_policy, is_physical=not is_random)
    for text in arguments.controller:
        players[text] = Player(partial(policy_of, text=text), is_physical=True)
    return players | {str(folder): agent_player(folder) for folder in arguments.agent}


def only_player(arguments: argparse.Namespace) -> Player:
    """Return the player where only one is allowed.

    Raises:
        ConfigError: If there are several, or as ``players_of``.
    """
    players = players_of(arguments)
    if len(players) > 1:
        raise ConfigError(f"one can act at a time, got {len(players)}: {', '.join(players)}")
    return next(iter(players.values()))


def output_of(text: str) -> Path | str:
    """A file to write; a text for a dataset of Minari."""
    return text if text.startswith(MINARI) else Path(text)


def check_counts(arguments: argparse.Namespace, *names: str) -> None:
    """Refuse counts below 1 and seeds that are none.

    Raises:
        ConfigError: If there are some.
    """
    check_seed(getattr(arguments, "seed", None))
    for name in names:
        check_count(f"--{name.replace('_', '-')}", getattr(arguments, name))


def say(text: str) -> None:
    """Print to standard output."""
    print(text)


def print_note(text: str, kind: str = "note") -> None:
    """Print a line to the error stream."""
    tell(f"fmugym: {kind}: {text}", is_needed=kind == "error")


def tell(text: str, *, is_needed: bool = False) -> None:
    """Print a line of progress to the error stream, unless ``--quiet`` leaves it out."""
    if is_needed or not quiet.get():
        print(plain(text), file=sys.stderr)


@contextmanager
def speaking(arguments: argparse.Namespace) -> Iterator[None]:
    """Say as much as ``--quiet`` and ``--verbose`` ask for.

    Without them, warnings of one kind are told some times only: where thousands of episodes are
    played, thousands may fail in the same way.
    """
    logger, handler = logging.getLogger("fmugym"), logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.ERROR if arguments.quiet else logging.INFO)
    token, level = quiet.set(arguments.quiet), logger.level
    kinds: Counter[tuple[str, int]] = Counter()

    def is_told(record: logging.LogRecord) -> bool:
        kind = record.pathname, record.lineno
        kinds[kind] += 1
        return kinds[kind] <= _OF_ONE_KIND

    if arguments.verbose:
        logger.setLevel(logging.INFO)
    else:
        handler.addFilter(is_told)
    logger.addHandler(handler)
    try:
        yield
    finally:
        left_out = sum(max(0, count - _OF_ONE_KIND) for count in kinds.values())
        if left_out:
            print_note(f"{left_out} more warnings of these kinds; -v shows them")
        quiet.reset(token)
        logger.removeHandler(handler)
        logger.setLevel(level)


@contextmanager
def free_outputs(arguments: argparse.Namespace) -> Iterator[None]:
    """Refuse files that exist before work is done for them; ``--force`` replaces them.

    An old file comes back if the command ends without a new one, or with one that an error, such as
    a full disk, has left incomplete.

    Raises:
        ConfigError: If a file exists, or its folder does not.
    """
    old: dict[Path, Path] = {}
    has_failed = False
    paths = [] if getattr(arguments, "resume", False) else list(_outputs_of(arguments))
    for path in paths:
        _require_free(path, arguments.force)
    try:
        for path in filter(_is_replaceable, paths):
            old[path] = path.rename(path.with_name(f".{path.name}.{os.getpid()}"))
        yield
    except BaseException as error:
        has_failed = not isinstance(error, KeyboardInterrupt)
        raise
    finally:
        for path, aside in old.items():
            if not _is_complete(path, has_failed):
                _remove(path)
                aside.rename(path)
            else:
                _remove(aside)


def _is_complete(path: Path, has_failed: bool) -> bool:
    """Whether there is a new file; files in the folder of a training are complete at any time."""
    return (path / AGENT_FILE).exists() if path.is_dir() else path.exists() and not has_failed


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _require_free(path: Path, is_forced: bool) -> None:
    if path.suffix and not path.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {shown(str(path.parent))}; make it first")
    if _is_replaceable(path) and not is_forced:
        raise ConfigError(f"{path} exists; name a new one, or replace it with --force")


def _is_replaceable(path: Path) -> bool:
    """Whether it is a file, or the folder of a training; no other folder is ever removed."""
    return path.is_file() or any((path / name).exists() for name in _OF_TRAININGS)


def _outputs_of(arguments: argparse.Namespace) -> Iterator[Path]:
    """The files that a command will write."""
    for name in arguments.files:
        given = getattr(arguments, name)
        for path in given if isinstance(given, list) else [given]:
            if not isinstance(path, Path):
                continue
            yield path
            beside = {".c": ".h"} | ({".toml": ".npz"} if arguments.command == "fit" else {})
            if path.suffix in beside:
                yield path.with_suffix(beside[path.suffix])


def say_json(facts: dict[str, Any]) -> None:
    """Print one JSON object."""
    say(json.dumps({"schema": _JSON_VERSION, **facts}, indent=2, default=str))


def say_result(arguments: argparse.Namespace, facts: Mapping[str, Any], text: str) -> None:
    """Print the result of a command: with ``--json`` as a JSON object, otherwise as a text."""
    if not arguments.json:
        say(text)
        return
    given = {name: one for name, one in vars(arguments).items() if name in ("task", "output")}
    say_json({**given, **facts})


@contextmanager
def shown_in_any_case(show: Callable[[], None]) -> Iterator[None]:
    """Show the result of a block, also after Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        show()
        raise
    show()


def require_toml(path: Path) -> None:
    """Refuse a task file with another ending before anything is played for it.

    Raises:
        ConfigError: If it has one.
    """
    if path.suffix.lower() != ".toml":
        raise ConfigError(f"a task file ends with .toml, got {shown(str(path))}")


def write_extension(path: Path, target: str, more: Mapping[str, Any]) -> None:
    """Write a task file that extends the given one by some keys; others have only these."""
    document: dict[str, Any] = dict(more)
    if Path(target).is_file():
        base = os.path.relpath(Path(target).absolute(), path.absolute().parent)
        document = {"extends": Path(base).as_posix(), **document}
    write_new(path, as_toml(document))


def _for_any_file(text: str) -> str:
    """A text whose letters are escaped unless standard output is UTF-8, as TOML and Python are."""
    if codecs.lookup(sys.stdout.encoding or "ascii").name == "utf-8":
        return text
    return text.encode("ascii", "backslashreplace").decode()


def write_text(text: str, output: Path | None, notes: Iterable[str]) -> None:
    """Write a text to a new file, or to standard output, and notes to the error stream."""
    if output is None:
        print(_for_any_file(text), end="")
    else:
        write_new(output, text)
    for one in notes:
        print_note(one)


_BETWEEN_LINES: Final = 10.0
_MINUTE: Final = 60.0
_HOUR: Final = 3600.0


@contextmanager
def watched(
    total: float | None, what: str, unit: str = "", clock: Callable[[], float] | None = None
) -> Iterator[Advance]:
    """Show the progress of a command, and the time that the rest may take.

    Args:
        total: All that is to be done; None if that is not known.
        what: A word for it.
        unit: Name of the counted things; "" if only parts are shown.
        clock: Tells seconds; that of the system by default.

    Yields:
        A function that is told what was done since the last call, and perhaps a text to show.
    """
    with progress_bar(total, what, unit) as advance:
        yield advance if advance is not no_progress else _lines(total, what, clock or monotonic)


def _lines(total: float | None, what: str, clock: Callable[[], float]) -> Advance:
    """Print progress every ten seconds: a text, or the part that is done."""
    begin = last = clock()
    done = 0.0

    def show(steps: float, text: str = "") -> None:
        nonlocal last, done
        done += steps
        now = clock()
        if now - last > _BETWEEN_LINES:
            last = now
            tell(text or _text(what, done, total, now - begin))

    return show


def _text(what: str, done: float, total: float | None, seconds: float) -> str:
    if not total or not done:
        return f"{what}: {_duration(seconds)}"
    part = min(done / total, 1.0)
    return f"{what}: {100 * part:.0f} %, about {_duration(seconds * (1 - part) / part)} left"


def _duration(seconds: float) -> str:
    if seconds < 2 * _MINUTE:
        return f"{seconds:.0f} s"
    return f"{seconds / _MINUTE:.0f} min" if seconds < 2 * _HOUR else f"{seconds / _HOUR:.1f} h"
