"""Commands about plants: ``serve``, ``simulate --plant``, and ``evaluate --log``.

``evaluate --log`` reads the log of a shadow, and compares the plant with other players.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np

from fmugym.checks import check_count, check_number, duration
from fmugym.cli.options import (
    Commands,
    add_command,
    add_json,
    add_players,
    check_counts,
    only_player,
    say,
    say_result,
    shown_in_any_case,
)
from fmugym.deployment.plant import Server, connect
from fmugym.deployment.plant.plant_server import with_plant
from fmugym.deployment.plant.shadow import Error
from fmugym.errors import ConfigError, plain, shown
from fmugym.pool.rig.clocks import RealClock
from fmugym.records.evaluation import HELD_OUT_SEED, Score, evaluate
from fmugym.records.output_files import EpisodeFiles
from fmugym.records.plant_log import PlantLog, as_logged, play_log
from fmugym.records.players import Player, Policy, Summary, simulate
from fmugym.records.progress_bars import Advance, progress_bar
from fmugym.records.recording import Recording
from fmugym.task import Task, load
from fmugym.task.task_writer import as_toml

__all__ = [
    "add_of_plants",
    "add_serve",
    "check_plant_options",
    "evaluate_log",
    "follow_plant",
    "plant_task",
]

_AHEAD: Final = "3h"


def add_of_plants(command: argparse.ArgumentParser) -> None:
    """Add the options for ``simulate --plant``."""
    group = command.add_argument_group("in the shadow of a plant (needs the extra plant)")
    text = "read the plant that [plant] of the task describes, or at another address; write nothing"
    group.add_argument("--plant", nargs="?", const="", metavar="ADDRESS", help=text)
    text = f"how far ahead copies of the FMU predict; default {_AHEAD}"
    group.add_argument("--ahead", metavar="TIME", help=text)
    _add_speed(group)


def check_plant_options(arguments: argparse.Namespace) -> None:
    """Refuse the options of ``simulate --plant`` without it."""
    for name in ("ahead", "speed"):
        if arguments.plant is None and getattr(arguments, name) is not None:
            raise ConfigError(f"--{name} is for --plant")


def _add_speed(command: Any) -> None:
    text = "seconds of the plant in a second of real time; default 1"
    command.add_argument("--speed", type=float, help=text)


def _clock(arguments: argparse.Namespace) -> RealClock:
    speed = 1.0 if arguments.speed is None else arguments.speed
    return RealClock(check_number("--speed", speed, positive=True))


def plant_task(arguments: argparse.Namespace) -> Task:
    """Read the task of a plant.

    Raises:
        ConfigError: If it is no file, or has a mistake.
    """
    if not Path(arguments.task).is_file():
        raise ConfigError(f"a plant needs a task file, got {shown(arguments.task)}")
    return Task.read(arguments.task)


def follow_plant(arguments: argparse.Namespace) -> None:
    """Let a player be the shadow of a plant for so many steps."""
    if arguments.scenario is not None or arguments.episodes != 1:
        raise ConfigError("a plant has no --scenario and no --episodes: say --steps")
    player = only_player(arguments)
    ahead = duration("--ahead", _AHEAD if arguments.ahead is None else arguments.ahead)
    make_env: Any = partial(
        connect,
        plant_task(arguments),
        arguments.plant or None,
        ahead=ahead,
        clock=_clock(arguments),
    )
    recording, done = EpisodeFiles(arguments.task, None, arguments.output), list[Summary]()
    with closing(player.make_env(make_env)) as env:
        shadow: Any = env
        played = shadow
        if arguments.output:
            played = recording.begin("shadow", shadow, arguments.variables, arguments.every)
        policy = player.make_policy(shadow.unwrapped)
        with (
            shown_in_any_case(lambda: _show(arguments, done, shadow.errors())),
            recording.finished(arguments.seed),
            progress_bar(arguments.steps, "shadow") as advance,
        ):
            while (left := arguments.steps - sum(one.steps for one in done)) > 0:
                done.append(simulate(played, policy, arguments.seed, left, advance))
                if not arguments.json:
                    say(plain(done[-1].as_text()))


def _show(arguments: argparse.Namespace, done: Sequence[Summary], errors: Sequence[Error]) -> None:
    episodes, predictions = [one.as_dict() for one in done], [one._asdict() for one in errors]
    text = "\n".join(map(plain, _table(errors)))
    if text or arguments.json:
        say_result(arguments, {"episodes": episodes, "predictions": predictions}, text)


def _table(errors: Sequence[Error]) -> list[str]:
    """Errors of predictions by variable, at horizons that double."""
    lines = []
    for name in dict.fromkeys(one.name for one in errors):
        own = [one for one in errors if one.name == name]
        powers = (2**power for power in range(len(own).bit_length()))
        chosen = [own[place - 1] for place in powers if place < len(own)] + own[-1:]
        cells = [f"{one.rms:.3g} ({one.bias:+.2g}) {one.ahead:g} s ahead" for one in chosen]
        lines.append(f"error of {name}, root mean square (and mean): {', '.join(cells)}")
    return lines


def add_serve(commands: Commands) -> None:
    """Add ``serve``."""
    text = "let the FMU of a task be a plant on the loopback, as [plant] of the task describes"
    command = add_command(commands, "serve", _serve, text)
    command.add_argument("task", metavar="TASK", help="a task file")
    protocols = command.add_mutually_exclusive_group()
    for name, shown_name in (("modbus", "Modbus TCP"), ("opcua", "OPC UA")):
        text = f"by {shown_name}; without [plant] in the task, print one to be added to it"
        protocols.add_argument(
            f"--{name}", action="store_const", const=name, dest="protocol", help=text
        )
    add_players(command)
    command.add_argument("--port", type=int, default=0, help="by default a free one")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="default 0")
    command.add_argument("--steps", type=int, metavar="N", help="how many; default no end")
    _add_speed(command)
    add_json(command)


def _serve(arguments: argparse.Namespace) -> None:
    check_counts(arguments)
    steps = arguments.steps if arguments.steps is None else check_count("--steps", arguments.steps)
    options = {"port": arguments.port, "seed": arguments.seed, "steps": steps}
    task, player = plant_task(arguments), only_player(arguments)
    has_plant = "plant" in task.document
    if arguments.protocol is not None:
        task = with_plant(task, arguments.protocol)
    elif not has_plant:
        raise ConfigError(f"{shown(arguments.task)} has no [plant]: say --modbus or --opcua")
    with Server(task, player, clock=_clock(arguments), **options) as server:
        plant = {**task.document["plant"], "address": server.address}
        text = f"serving {plain(arguments.task)} at {server.address}; Ctrl-C ends it"
        if not has_plant:
            text += f"\nadd this to the task:\n\n{as_toml({'plant': plant})}"
        say_result(arguments, {"address": server.address, "plant": plant}, text)
        sys.stdout.flush()  # a program may wait for the address
        with shown_in_any_case(
            lambda: None if arguments.json else say(plain(server.summary().as_text()))
        ):
            while not server.wait(0.2):
                pass


class _Costs(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Adds up the costs of episodes."""

    def __init__(self, env: Any, totals: list[float]) -> None:
        super().__init__(env)
        self._totals = totals

    def reset(self, **arguments: Any) -> tuple[Any, dict[str, Any]]:
        self._totals.append(0.0)
        return self.env.reset(**arguments)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        found = self.env.step(action)
        self._totals[-1] += float(found[-1].get("cost", 0.0))
        return found


def evaluate_log(
    task: Task,
    log: PlantLog,
    players: Mapping[str, Player],
    advance: Advance,
    leave_out: Callable[[str, Exception], None] | None = None,
) -> Iterator[Score]:
    """Compare the plant's results with other players on the FMU in the same periods.

    Args:
        task: The task.
        log: The record of a shadow, whose times are seconds of the year.
        players: Players on the FMU.
        advance: Is told of each step on the FMU, as a part of all.
        leave_out: See ``evaluate``.

    Yields:
        The score of the plant, as it was measured; those of the FMU with the actions that acted and
        that were proposed; and those of the players.

    Raises:
        ConfigError: If the log does not fit the task.
    """
    task = as_logged(task, log)
    costs: list[float] = []
    recordings = play_log(log, lambda **more: _Costs(load(task, physical=True, **more), costs))
    yield Score(
        "plant, measured",
        tuple(float(one.rewards.sum()) for one in recordings),
        tuple(costs) if "costs" in task.document else (),
        tuple(map(len, recordings)),
        {"measured": len(recordings)},
        1.0,
    )
    acted = {"actions of the plant": _replayed(recordings)}
    if log.proposed is not None:
        proposals = play_log(log.proposed, partial(load, task, physical=True))
        acted["proposed actions"] = _replayed(proposals)
    periods = [(one.drawn["start_time"], len(one)) for one in recordings]
    seeds = range(HELD_OUT_SEED, HELD_OUT_SEED + len(periods))
    most = max(map(len, recordings))
    players = {**acted, **players}
    count = len(periods) * len(players)
    yield from evaluate(
        partial(load, task),
        players,
        seeds,
        most,
        None,
        lambda part: advance(part / count),
        periods=periods,
        leave_out=leave_out,
    )


def _replayed(recordings: Sequence[Recording]) -> Player:
    """Player that repeats logged actions, episode by episode."""
    left: Iterator[np.ndarray[Any, Any]] = iter(())
    each = iter(recordings)

    def begin() -> None:
        nonlocal left
        left = iter(next(each).actions)

    return Player(lambda env: Policy(lambda observation: next(left), begin), is_physical=True)
