"""Command ``tune``: numbers of a controller."""

from __future__ import annotations

import argparse
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Final

from fmugym.baselines import Tuning, tune
from fmugym.baselines.parsing import TunableController, search_of
from fmugym.baselines.table_texts import is_table, table_in
from fmugym.episodes.simulation import given_controller
from fmugym.errors import ConfigError, shown
from fmugym.tools.options import (
    Commands,
    add_command,
    add_episodes,
    add_json,
    add_task,
    check_counts,
    print_note,
    require_toml,
    say_result,
    shown_in_any_case,
    tell,
    write_extension,
)
from fmugym.tools.targets import player_maker
from fmugym.tools.watching import watched

__all__ = ["add_tune"]

_HELP_OF_CONTROLLER: Final = (
    "a controller with ranges in the place of the numbers that are to be found: "
    "'pid of=T setpoint=20..22 kp=0.05..5 ti=1800..400000', a table of several, or the name of one "
    "in the task file"
)


def add_tune(commands: Commands) -> None:
    """Add ``tune``."""
    text = "find the numbers with which a controller gets the largest rewards"
    command = add_command(commands, "tune", _tune, text)
    add_task(command)
    command.add_argument("controller", metavar="CONTROLLER", help=_HELP_OF_CONTROLLER)
    command.add_argument("--scenario", help="a scenario of the task file, instead of its episodes")
    command.add_argument("--rounds", type=int, default=20, help="default 20")
    command.add_argument(
        "--candidates", type=int, default=32, help="that play in each round; default 32"
    )
    add_episodes(command, 8, 0)
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new task file that has the controller"
    )
    command.add_argument("--name", default="tuned", help="of the controller there; default tuned")
    add_json(command)


def _tune(arguments: argparse.Namespace) -> None:
    check_counts(arguments, "rounds", "candidates", "episodes", "steps")
    search = _search_in(arguments)
    output: Path | None = arguments.output
    if output is not None:
        _require_name(arguments.name)
        require_toml(output)
    found: list[Tuning] = []
    with shown_in_any_case(lambda: _show(search, found, arguments)):
        _search(search, arguments, found)


def _search_in(arguments: argparse.Namespace) -> TunableController:
    """The controller with its ranges; its name in the task file will do, and names in a table."""
    text: str = arguments.controller
    if text.isidentifier() or is_table(text):
        with closing(player_maker(arguments.task, master=arguments.master)(physical=True)) as env:
            text = str(given_controller(env, text))
    return search_of(text)


def _search(search: TunableController, arguments: argparse.Namespace, found: list[Tuning]) -> None:
    """Search, and keep the best of each round."""
    make_env = partial(
        player_maker(arguments.task, arguments.scenario, arguments.master), physical=True
    )
    with watched(arguments.rounds, "tune") as advance:

        def noted(best: Tuning) -> None:
            found.append(best)
            text = search.text(best.parameters)
            tell(f"round {len(best.returns)}: reward {best.mean_return:.6g} by {text}")

        tune(
            search.make,
            make_env,
            search.ranges,
            candidates=arguments.candidates,
            episodes=arguments.episodes,
            rounds=arguments.rounds,
            most_steps=arguments.steps,
            seed=arguments.seed,
            watch=noted,
            advance=advance,
        )


def _show(search: TunableController, found: list[Tuning], arguments: argparse.Namespace) -> None:
    if not found:
        print_note("interrupted before the first round was over; nothing is found")
        return
    best, output = found[-1], arguments.output
    text = search.text(best.parameters)
    if output is not None:
        made = table_in(text) if is_table(text) else text
        write_extension(output, arguments.task, {"controllers": {arguments.name: made}})
    for name in search.at_an_end(best.parameters):
        print_note(f"the best {name} is at an end of its range; a wider one may have a better one")
    facts = {"controller": text, "parameters": search.numbers(best.parameters)}
    reward = {"mean_reward": best.mean_return, "rewards_of_rounds": best.returns}
    say_result(arguments, {**facts, **reward}, text)


def _require_name(name: str) -> None:
    if not name.isidentifier() or not name.isascii():
        raise ConfigError(f"a controller has a name such as 'tuned', got {shown(name)}")
