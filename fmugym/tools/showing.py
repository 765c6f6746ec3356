"""The command that shows what the package does: demo."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from fmugym.errors import ConfigError, plain
from fmugym.tools.demo import LinearController, Training, show, write_picture
from fmugym.tools.options import Commands, add_command, add_json, check_numbers, say, say_result

__all__ = ["add_demo"]


def add_demo(commands: Commands) -> None:
    """Add ``demo``."""
    text = "train a controller of the bundled cart-pole in seconds, and show it in a window"
    command = add_command(commands, "demo", _demo, text)
    command.add_argument("--seed", type=int, default=0, help="default 0")
    command.add_argument(
        "--output", type=Path, metavar="FILE", help="a new PNG file, instead of the window"
    )
    add_json(command)


def _demo(arguments: argparse.Namespace) -> int:
    check_numbers(arguments)
    training = Training(arguments.seed)
    untrained, rounds = training.controller, []
    for one in training.rounds():
        rounds.append(one)
        if not arguments.json:
            say(
                f"round {one.number}: {one.mean:.0f} steps in the mean, {one.best:.0f} at best; "
                f"controller {one.held_out:.0f} of 500"
            )
    steps, seconds = training.steps, training.seconds
    facts = {"rounds": [asdict(one) for one in rounds], "steps": steps, "seconds": seconds}
    say_result(arguments, facts, f"{steps} steps of the cart-pole FMU in {seconds:.2f} s")
    _show(untrained, training.controller, arguments)
    return int(not rounds or not rounds[-1].is_solved)


def _show(
    untrained: LinearController, trained: LinearController, arguments: argparse.Namespace
) -> None:
    seed = arguments.seed + 2_000_000
    if arguments.output is not None:
        write_picture([untrained, trained], seed, arguments.output)
        if not arguments.json:
            say(plain(f"{arguments.output}: an episode before the training, and one after it"))
        return
    if arguments.json:
        return
    try:
        say(f"before the training: {show(untrained, seed)} steps")
        say(f"after the training: {show(trained, seed)} steps")
    except ConfigError:
        say("There is no display for a window: --output demo.png writes a picture")
