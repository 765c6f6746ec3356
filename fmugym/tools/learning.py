"""The command that trains: train."""

from __future__ import annotations

import argparse
from pathlib import Path

from fmugym.tools.evaluation import table
from fmugym.tools.options import (
    Commands,
    add_command,
    add_task,
    check_numbers,
    say,
    tell,
)
from fmugym.tools.targets import maker_of, scenarios_of
from fmugym.tools.training import Plan, arguments_of, train

__all__ = ["add_train"]


def add_train(commands: Commands) -> None:
    """Add ``train``."""
    text = "train an agent with Stable-Baselines3, and keep the best one"
    command = add_command(commands, "train", _train, text)
    add_task(command)
    command.add_argument(
        "arguments", nargs="*", metavar="KEY=VALUE", help="arguments of the algorithm"
    )
    command.add_argument("--output", type=Path, required=True, metavar="FOLDER", help="a new one")
    command.add_argument("--algorithm", default="PPO", help="PPO (default), A2C, SAC, TD3, DQN ...")
    command.add_argument("--steps", type=int, default=100_000, help="default 100000")
    command.add_argument("--envs", type=int, default=8, help="that step together; default 8")
    command.add_argument("--seed", type=int, default=0, help="default 0")
    command.add_argument("--episodes", type=int, default=5, help="of an evaluation; default 5")
    command.add_argument(
        "--no-normalize", action="store_true", help="without running normalization"
    )


def _train(arguments: argparse.Namespace) -> None:
    check_numbers(arguments, "steps", "envs", "episodes")
    names = scenarios_of(arguments.task)
    held_out = {name: maker_of(arguments.task, name) for name in names}
    plan = Plan(
        maker_of(arguments.task),
        held_out or {"held-out seeds": maker_of(arguments.task)},
        arguments.output,
        arguments.algorithm,
        arguments.steps,
        arguments.envs,
        arguments.seed,
        arguments.episodes,
        normalize=not arguments.no_normalize,
        arguments=arguments_of(arguments.arguments),
    )
    say(table(train(plan, tell)))
