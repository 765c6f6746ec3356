"""Commands ``train`` and ``tune``: agents, and the numbers of a controller."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from functools import partial
from math import isfinite
from pathlib import Path
from time import monotonic
from typing import Any, Final

from fmugym.checks import check_number
from fmugym.cli.options import (
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
    watched,
    write_extension,
)
from fmugym.cli.task_arguments import maker_of, player_maker, scenarios_of
from fmugym.control import Tuning, tune
from fmugym.control.controller_parsing import TunableController, search_of
from fmugym.control.controller_table import is_table, table_in
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.records.evaluation import Score, table
from fmugym.records.output_files import title_of
from fmugym.records.players import given_controller
from fmugym.training.agents import AGENT_FILE
from fmugym.training.checkpoints import CHECKPOINT
from fmugym.training.hyperparameters import tune_hyperparameters
from fmugym.training.residual import residual_facts
from fmugym.training.sb3_training import (
    TRAINING,
    TrainingSettings,
    Watch,
    algorithm_arguments,
    facts_of,
    fitting_envs,
    train,
)
from fmugym.training.search_training import STATE, Searching
from fmugym.training.training_records import TRACKERS, TrainingRecords, tracker_for
from fmugym.training.training_report import write_curve, write_outcome

__all__ = ["add_train", "add_tune"]

_DEFAULTS: Final[dict[str, Any]] = {
    "algorithm": None,
    "steps": 100_000,
    "envs": None,
    "seed": 0,
    "episodes": 5,
    "normalize": True,
}
"""Defaults of options that neither the user nor a resumed training gives."""


def add_train(commands: Commands) -> None:
    """Add ``train``."""
    text = "find an agent that beats the controllers of the task, and compare it with them"
    command = add_command(commands, "train", _train, text)
    add_task(command)
    command.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="a new one")
    command.add_argument(
        "--minutes",
        type=float,
        help="of the search, without its test; default 1, or no limit with --rounds",
    )
    command.add_argument(
        "--rounds", type=int, help="that the search ends with: repeats an earlier one"
    )
    command.add_argument("--steps", type=int, help="of all environments together, at most")
    command.add_argument(
        "--envs", type=int, help="that step together; default 256, or as many as fit with PPO"
    )
    command.add_argument("--seed", type=int, help="default 0")
    command.add_argument("--episodes", type=int, help="of a test; default 100, 4 of each scenario")
    command.add_argument(
        "--resume", action="store_true", help="go on with the training in the folder"
    )
    _add_of_algorithms(command)
    add_json(command)


def _add_of_algorithms(command: argparse.ArgumentParser) -> None:
    """Add the options for trainings with Stable-Baselines3."""
    group = command.add_argument_group("with --algorithm (needs the extra sb3)")
    group.add_argument(
        "arguments", nargs="*", metavar="KEY=VALUE", help="arguments of the algorithm"
    )
    group.add_argument("--algorithm", help="PPO, A2C, SAC, TD3, DQN ... instead of the search")
    group.add_argument(
        "--residual", metavar="NAME", help="add to the action of this controller of the task"
    )
    group.add_argument(
        "--residual-scale",
        type=float,
        metavar="PART",
        help="of the range that is added at most; default 0.3",
    )
    group.add_argument(
        "--no-normalize",
        action="store_false",
        dest="normalize",
        default=None,
        help="without running normalization",
    )
    group.add_argument(
        "--tune", type=int, metavar="N", help="first try N sets of arguments with Optuna"
    )
    group.add_argument(
        "--tune-steps", type=int, metavar="N", help="of each of these; default a tenth of --steps"
    )
    group.add_argument(
        "--record",
        action="append",
        metavar="GLOB",
        help="record these variables in training and evaluations, and write a report",
    )
    group.add_argument(
        "--record-env",
        type=int,
        action="append",
        metavar="N",
        help="the number of a recorded environment of the training; more than once for several; "
        "default 0",
    )
    group.add_argument(
        "--record-every", type=float, metavar="SECONDS", help="between rows; default each step"
    )
    group.add_argument("--record-format", help="csv (default) or parquet")
    group.add_argument("--track", choices=sorted(TRACKERS), help="log to this library, too")


_OF_ALGORITHMS: Final = (
    *("arguments", "normalize", "tune", "tune_steps", "record", "record_env"),
    *("record_every", "record_format", "track", "residual", "residual_scale"),
)
_OF_SEARCHES: Final = ("minutes", "rounds")
_SCALE: Final = 0.3
"""Largest correction by a residual policy, as a part of the range of actions."""
_OTHERWISE: Final = {"arguments": "KEY=VALUE", "normalize": "--no-normalize"}
_COUNTS: Final = ("rounds", "steps", "envs", "episodes")


def _train(arguments: argparse.Namespace) -> None:
    has_algorithm = arguments.resume and (arguments.output / TRAINING).exists()
    is_search = arguments.algorithm is None and not has_algorithm
    if is_search:
        _refuse(arguments, _OF_ALGORITHMS, "is for trainings with --algorithm, such as PPO")
        if arguments.resume:
            _refuse(arguments, ("seed",), "cannot be changed by --resume")
    else:
        _refuse(arguments, _OF_SEARCHES, "is for searches, without --algorithm")
    try:
        _search(arguments) if is_search else _learn(arguments)
    except OSError as error:  # what writes to open files does not say where
        error.filename = error.filename or str(arguments.output)
        raise


def _refuse(arguments: argparse.Namespace, names: Iterable[str], why: str) -> None:
    for name in names:
        if getattr(arguments, name) not in (None, []):
            option = _OTHERWISE.get(name, f"--{name.replace('_', '-')}")
            raise ConfigError(f"{option} {why}")


def _search(arguments: argparse.Namespace) -> None:
    given = {name: getattr(arguments, name) for name in _COUNTS}
    counts = {name: value for name, value in given.items() if value is not None}
    check_counts(arguments, *counts)
    if arguments.minutes is not None:
        check_number("--minutes", arguments.minutes, positive=True)
    task, master = arguments.task, arguments.master
    make_env = partial(maker_of(task, master=master), physical=True)
    scenarios = {
        name: partial(maker_of(task, name, master), physical=True) for name in scenarios_of(task)
    }
    searching = Searching(
        make_env,
        scenarios or {"unseen episodes": make_env},
        arguments.output,
        arguments.minutes,
        seed=arguments.seed or 0,
        tell=tell,
        **counts,
    )
    total = round(searching.seconds) if isfinite(searching.seconds) else None
    with watched(total, "train", "s", lambda: monotonic()) as advance:
        searching.advance, searching.progress = advance, watched
        try:
            facts = searching.run(resume=arguments.resume)
        except KeyboardInterrupt:
            _tell_what_is_kept(arguments.output, STATE)
            raise
    write_curve(arguments.output, f"{title_of(arguments.task)}, trained by a search", tell)
    say_result(arguments, facts, facts["verdict"])
    if not arguments.json:
        _tell_faults(
            {name: one["mean_costs"]["failed episodes"] for name, one in facts["test"].items()}
        )
        if facts["controller"]:
            tell(f"its controller: {facts['controller']}")
        options = f"; to repeat the search: --rounds {facts['rounds']}"
        is_repeated = facts["rounds"] and "surrogate" not in facts
        tell(f"the agent is in {arguments.output}{options if is_repeated else ''}")


def _tell_faults(parts: Mapping[str, float]) -> None:
    """Report faults, which may have decided beside the rewards."""
    if any(parts.values()):
        listing = ", ".join(f"{name} {100 * part:.3g} %" for name, part in parts.items())
        tell(f"episodes that a fault has cut short, which count before the reward: {listing}")


def _learn(arguments: argparse.Namespace) -> None:
    settings, begin_tracker = _settings_of(arguments), None
    if arguments.track is not None:
        facts = {"task": arguments.task, "steps": settings.steps, **settings.facts()}
        begin_tracker = tracker_for(arguments.track, facts, settings.folder)
    if arguments.tune is not None:
        settings = _tuned(settings, arguments)
    with watched(settings.steps, "train", "steps") as advance:
        watch = Watch(tell, advance, begin_tracker=begin_tracker)
        try:
            scores = train(settings, resume=arguments.resume, watch=watch)
        except KeyboardInterrupt:
            _tell_what_is_kept(settings.folder, CHECKPOINT)
            write_outcome(settings, title_of(arguments.task), tell)
            raise
    write_outcome(settings, title_of(arguments.task), tell)
    _show(settings, scores, arguments)


def _tell_what_is_kept(folder: Path, state: str) -> None:
    """After Ctrl-C."""
    if not (folder / AGENT_FILE).exists():
        tell("nothing was trained yet")
    elif (folder / state).exists():
        tell(f"{folder} has the best agent until now; --resume goes on with the training")
    else:
        tell(f"{folder} has the best agent until now; the training was too short to resume it")


def _settings_of(arguments: argparse.Namespace) -> TrainingSettings:
    """Settings of a training, from the options and from the training that is resumed."""
    before = facts_of(arguments.output) if arguments.resume else {}
    for name, default in _DEFAULTS.items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, before.get(name, default))
    names, master = scenarios_of(arguments.task), arguments.master
    make_env = maker_of(arguments.task, master=master)
    if arguments.envs is None:
        arguments.envs = fitting_envs(make_env)
    check_counts(arguments, "steps", "envs", "episodes")
    own = algorithm_arguments(arguments.arguments) or before.get("arguments", {})
    held_out = {name: maker_of(arguments.task, name, master) for name in names}
    return TrainingSettings(
        make_env,
        held_out or {"held-out seeds": make_env},
        arguments.output,
        arguments.algorithm,
        arguments.steps,
        arguments.envs,
        arguments.seed,
        arguments.episodes,
        normalize=arguments.normalize,
        arguments=own,
        residual=_residual_of(arguments, make_env, before.get("residual")),
        records=_records_of(arguments, before.get("record")),
    )


def _residual_of(
    arguments: argparse.Namespace, make_env: Callable[..., FMUEnv], before: Any
) -> Any:
    """Residual policy of the options, or else of the training that is resumed."""
    if arguments.residual is None:
        if arguments.residual_scale is not None:
            raise ConfigError("name the controller, too: --residual NAME")
        return before
    scale = _SCALE if arguments.residual_scale is None else arguments.residual_scale
    return residual_facts(make_env, arguments.residual, scale, tell)


def _records_of(arguments: argparse.Namespace, before: Any) -> TrainingRecords | None:
    """Records of the options, or else of the training that is resumed."""
    own = (arguments.record_env, arguments.record_every, arguments.record_format)
    if arguments.record is None:
        if any(one is not None for one in own):
            raise ConfigError("name the variables to record, too: --record '*'")
        return TrainingRecords.of(before)
    environments = tuple(arguments.record_env or (0,))
    return TrainingRecords(tuple(arguments.record), environments, own[1], own[2] or "csv")


def _tuned(settings: TrainingSettings, arguments: argparse.Namespace) -> TrainingSettings:
    if arguments.resume:
        raise ConfigError("--tune is for a new training, which --resume is not")
    arguments.tune_steps = arguments.tune_steps or max(1, settings.steps // 10)
    check_counts(arguments, "tune", "tune_steps")
    with watched(arguments.tune, "tune", "trials") as advance:

        def noted(line: str) -> None:
            advance(1)
            tell(line)

        best = tune_hyperparameters(settings, arguments.tune, arguments.tune_steps, noted)
    tell(f"the best arguments are {json.dumps(best)}")
    return replace(settings, arguments=best)


def _show(settings: TrainingSettings, scores: list[Score], arguments: argparse.Namespace) -> None:
    best = json.loads((settings.folder / AGENT_FILE).read_text(encoding="utf-8"))
    told = {"best": best, "scores": [one.as_dict() for one in scores]}
    facts = {"steps": settings.steps, **settings.facts(), **told}
    say_result(arguments, facts, table(scores))


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
    with shown_in_any_case(lambda: _show_tuning(search, found, arguments)):
        _tune_rounds(search, arguments, found)


def _search_in(arguments: argparse.Namespace) -> TunableController:
    """The controller with its ranges; its name in the task file will do, and names in a table."""
    text: str = arguments.controller
    if text.isidentifier() or is_table(text):
        with closing(player_maker(arguments.task, master=arguments.master)(physical=True)) as env:
            text = str(given_controller(env, text))
    return search_of(text)


def _tune_rounds(
    search: TunableController, arguments: argparse.Namespace, found: list[Tuning]
) -> None:
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


def _show_tuning(
    search: TunableController, found: list[Tuning], arguments: argparse.Namespace
) -> None:
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
