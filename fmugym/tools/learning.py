"""The command that trains: train."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from fmugym.errors import ConfigError
from fmugym.signals import ordinary
from fmugym.tools.agents import FACTS
from fmugym.tools.checkpoints import CHECKPOINT
from fmugym.tools.diary import Diary
from fmugym.tools.evaluation import Score, table
from fmugym.tools.options import (
    Commands,
    add_command,
    add_json,
    add_task,
    check_numbers,
    say,
    say_json,
    tell,
)
from fmugym.tools.outcome import write_outcome
from fmugym.tools.progress import progress
from fmugym.tools.records import title_of
from fmugym.tools.targets import maker_of, scenarios_of
from fmugym.tools.tracking import TRACKERS, tracker_for
from fmugym.tools.training import Plan, Watch, arguments_of, facts_of, train
from fmugym.tools.tuning import tune

__all__ = ["add_train"]

_DEFAULTS: Final[dict[str, Any]] = {
    "algorithm": "PPO",
    "steps": 100_000,
    "envs": 8,
    "seed": 0,
    "episodes": 5,
    "normalize": True,
}
"""What holds if neither the options nor a training that is resumed say otherwise."""


def add_train(commands: Commands) -> None:
    """Add ``train``."""
    text = "train an agent with Stable-Baselines3, and keep the best one"
    command = add_command(commands, "train", _train, text)
    add_task(command)
    command.add_argument(
        "arguments", nargs="*", metavar="KEY=VALUE", help="arguments of the algorithm"
    )
    command.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="a new one")
    command.add_argument("--algorithm", help="PPO (default), A2C, SAC, TD3, DQN ...")
    command.add_argument("--steps", type=int, help="of all environments, at most; default 100000")
    command.add_argument("--envs", type=int, help="that step together; default 8")
    command.add_argument("--seed", type=int, help="default 0")
    command.add_argument("--episodes", type=int, help="of an evaluation; default 5")
    command.add_argument(
        "--no-normalize",
        action="store_false",
        dest="normalize",
        default=None,
        help="without running normalization",
    )
    command.add_argument(
        "--resume", action="store_true", help="go on with the training in the folder"
    )
    command.add_argument(
        "--tune", type=int, metavar="N", help="first try N sets of arguments with Optuna"
    )
    command.add_argument(
        "--tune-steps", type=int, metavar="N", help="of each of these; default a tenth of --steps"
    )
    command.add_argument(
        "--record",
        action="append",
        metavar="GLOB",
        help="record these variables in training and evaluations, and write a report",
    )
    command.add_argument(
        "--record-env",
        type=int,
        action="append",
        metavar="N",
        help="the number of a recorded environment of the training; more than once for several; "
        "default 0",
    )
    command.add_argument(
        "--record-every", type=float, metavar="SECONDS", help="between rows; default each step"
    )
    command.add_argument("--record-format", help="csv (default) or parquet")
    command.add_argument("--track", choices=sorted(TRACKERS), help="log to this library, too")
    add_json(command)


def _train(arguments: argparse.Namespace) -> None:
    plan, begin_tracker = _plan_of(arguments), None
    if arguments.track is not None:
        facts = {"task": arguments.task, "steps": plan.steps, **plan.facts()}
        begin_tracker = tracker_for(arguments.track, facts, plan.folder)
    if arguments.tune is not None:
        plan = _tuned(plan, arguments)
    with progress(plan.steps, "train") as advance:
        watch = Watch(tell, advance, begin_tracker=begin_tracker)
        try:
            scores = train(plan, resume=arguments.resume, watch=watch)
        except KeyboardInterrupt:
            _tell_what_is_kept(plan)
            write_outcome(plan, title_of(arguments.task), tell)
            raise
        except ordinary(OSError) as error:  # libraries that write a model do not say where
            error.filename = error.filename or str(plan.folder)
            raise
    write_outcome(plan, title_of(arguments.task), tell)
    _show(plan, scores, arguments)


def _tell_what_is_kept(plan: Plan) -> None:
    """After Ctrl-C."""
    if not (plan.folder / FACTS).exists():
        tell("nothing was trained yet")
    elif (plan.folder / CHECKPOINT).exists():
        tell(f"{plan.folder} has the best agent until now; --resume goes on with the training")
    else:
        tell(f"{plan.folder} has the best agent until now; the training was too short to resume it")


def _plan_of(arguments: argparse.Namespace) -> Plan:
    """The plan that the options make, together with what a training was begun with."""
    before = facts_of(arguments.output) if arguments.resume else {}
    given = {name: getattr(arguments, name) for name in _DEFAULTS}
    for name, default in _DEFAULTS.items():
        if given[name] is None:
            given[name] = before.get(name, default)
    options = argparse.Namespace(**given)
    check_numbers(options, "steps", "envs", "episodes")
    own = arguments_of(arguments.arguments) or before.get("arguments", {})
    names, master = scenarios_of(arguments.task), arguments.master
    make_env = maker_of(arguments.task, master=master)
    held_out = {name: maker_of(arguments.task, name, master) for name in names}
    return Plan(
        make_env,
        held_out or {"held-out seeds": make_env},
        arguments.output,
        options.algorithm,
        options.steps,
        options.envs,
        options.seed,
        options.episodes,
        normalize=options.normalize,
        arguments=own,
        diary=_diary_of(arguments, before.get("record")),
    )


def _diary_of(arguments: argparse.Namespace, before: Any) -> Diary | None:
    """What the options say to record; without any, what the training was begun with."""
    own = (arguments.record_env, arguments.record_every, arguments.record_format)
    if arguments.record is None:
        if any(one is not None for one in own):
            raise ConfigError("name the variables to record, too: --record '*'")
        return Diary.of(before)
    environments = tuple(arguments.record_env or (0,))
    return Diary(tuple(arguments.record), environments, own[1], own[2] or "csv")


def _tuned(plan: Plan, arguments: argparse.Namespace) -> Plan:
    if arguments.resume:
        raise ConfigError("--tune is for a new training, which --resume is not")
    arguments.tune_steps = arguments.tune_steps or max(1, plan.steps // 10)
    check_numbers(arguments, "tune", "tune_steps")
    with progress(arguments.tune, "tune", "trials") as advance:

        def noted(line: str) -> None:
            advance(1)
            tell(line)

        best = tune(plan, arguments.tune, arguments.tune_steps, noted)
    tell(f"the best arguments are {json.dumps(best)}")
    return replace(plan, arguments=best)


def _show(plan: Plan, scores: list[Score], arguments: argparse.Namespace) -> None:
    if not arguments.json:
        say(table(scores))
        return
    best = json.loads((plan.folder / FACTS).read_text(encoding="utf-8"))
    facts = {"task": arguments.task, "output": arguments.output, "steps": plan.steps}
    told = {"best": best, "scores": [one.as_dict() for one in scores]}
    say_json({**facts, **plan.facts(), **told})
