"""What commands of the command line share: arguments, who acts, and output."""

from __future__ import annotations

import argparse
import codecs
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

from fmugym.checks import check_count, check_seed
from fmugym.errors import ConfigError, shown
from fmugym.systems.plan import MASTERS
from fmugym.tools.agents import agent_player
from fmugym.tools.overview import plain
from fmugym.tools.simulation import Player, action_of, policy_of

__all__ = [
    "HELP_OF_TASK",
    "Commands",
    "add_command",
    "add_episodes",
    "add_json",
    "add_master",
    "add_players",
    "add_task",
    "check_numbers",
    "note",
    "only_player",
    "players_of",
    "require_folder",
    "say",
    "say_json",
    "shown_in_any_case",
    "tell",
    "write_text",
]

Commands = Any
"""The object that ``ArgumentParser.add_subparsers`` returns."""

HELP_OF_TASK: Final = "a task file, a registered id or module:Class"
_CONTROLLER: Final = "a controller and its arguments: 'pid of=T setpoint=21 kp=0.5 ti=14400'"
_ACTION: Final = "random, or the numbers of one action: 0.5,-1"
SCHEMA: Final = 1
"""Of the JSON; raised when a key goes or changes its meaning."""


def add_command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int | None],
    text: str,
) -> argparse.ArgumentParser:
    """Add a command that calls a function with the arguments."""
    command: argparse.ArgumentParser = commands.add_parser(
        name, help=text, description=f"{text[0].upper()}{text[1:]}."
    )
    command.set_defaults(run=run)
    return command


def add_json(command: argparse.ArgumentParser) -> None:
    """Add the option that all commands have."""
    command.add_argument("--json", action="store_true", help="print one JSON object")


def add_task(command: argparse.ArgumentParser, also: str = "") -> None:
    """Add the argument for the task."""
    command.add_argument("task", metavar="TASK", help=HELP_OF_TASK + also)
    add_master(command)


def add_master(command: argparse.ArgumentParser) -> None:
    """Add the option for how systems run."""
    text = "how a system exchanges values, in the place of what its SSP archive or task says"
    command.add_argument("--master", choices=MASTERS, help=text)


def add_episodes(
    command: argparse.ArgumentParser, episodes: int, seed: int, *, steps: bool = True
) -> None:
    """Add the options for which episodes are played."""
    command.add_argument("--episodes", type=int, default=episodes, help=f"default {episodes}")
    command.add_argument(
        "--seed", type=int, default=seed, help=f"of the first episode; default {seed}"
    )
    if steps:
        command.add_argument("--steps", type=int, default=10_000, help="at most, in each episode")


def add_players(command: argparse.ArgumentParser) -> None:
    """Add the options for who acts, each of which may be given several times."""
    command.add_argument("--action", action="append", default=[], help=_ACTION)
    command.add_argument(
        "--controller", action="append", default=[], metavar="TEXT", help=_CONTROLLER
    )
    command.add_argument(
        "--agent", type=Path, action="append", default=[], metavar="FOLDER", help="of train"
    )


def players_of(arguments: argparse.Namespace, *, random: bool = False) -> dict[str, Player]:
    """Make those who act, by name, of the options of ``add_players``.

    Args:
        arguments: Those of the command line.
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
    """The one who acts, where there can be only one.

    Raises:
        ConfigError: If there are several, or as ``players_of``.
    """
    players = players_of(arguments)
    if len(players) > 1:
        raise ConfigError(f"one can act at a time, got {len(players)}: {', '.join(players)}")
    return next(iter(players.values()))


def check_numbers(arguments: argparse.Namespace, *names: str) -> None:
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


def note(text: str, kind: str = "note") -> None:
    """Print a line to the error stream."""
    print(f"fmugym: {kind}: {plain(text)}", file=sys.stderr)


def tell(text: str) -> None:
    """Print a line of progress to the error stream."""
    print(plain(text), file=sys.stderr)


def say_json(facts: dict[str, Any]) -> None:
    """Print one JSON object."""
    say(json.dumps({"schema": SCHEMA, **facts}, indent=2, default=str))


@contextmanager
def shown_in_any_case(show: Callable[[], None]) -> Iterator[None]:
    """Show what was found, also after Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        show()
        raise
    show()


def require_folder(path: Path) -> None:
    """Refuse a file whose folder does not exist, before work is done for it.

    Raises:
        ConfigError: If there is no such folder.
    """
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {shown(str(path.parent))}; make it first")


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
        with output.open("x", encoding="utf-8", newline="\n") as file:
            file.write(text)
    for one in notes:
        note(one)
