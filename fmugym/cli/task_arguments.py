"""Targets of the command line: task files, ids, classes and FMUs."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from contextlib import ExitStack, closing
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Any, Final

import gymnasium

from fmugym.cli.overview import open_model
from fmugym.cli.task_proposal import Proposal
from fmugym.environment.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.task import Task, load
from fmugym.task.likely_units import require_units

__all__ = ["maker_of", "player_maker", "scenarios_of"]

_MODELS: Final = {".fmu", ".ssp"}


def maker_of(
    target: str,
    scenario: str | None = None,
    master: str | None = None,
    *,
    takes_fmu: bool = False,
) -> Callable[..., FMUEnv]:
    """Find the maker of the environment that a text names.

    Args:
        target: The path of a task file, a registered id, or ``"module:Class"``.
        scenario: A scenario of the task file; None for any episodes.
        master: Master algorithm of a system, in the place of the one of its archive or task.
        takes_fmu: Whether the path of an FMU or an SSP archive will do, too. It stands for the task
            that ``fmugym new`` proposes, whose reward is a guess that somebody has to look at.

    Returns:
        A function that makes the environment. It takes arguments of the environment, and
        ``physical=True`` for the physical form of a task; an id and a class that takes no task
        have one form only, which ``require_physical`` of the controllers may refuse.

    Raises:
        ConfigError: If there is no such thing, or the task has a mistake.
        FMULoadError: If the FMU cannot be read.
    """
    path = Path(target)
    own: dict[str, Any] = {} if master is None else {"master": master}
    if path.suffix.lower() in _MODELS:
        if path.is_file() and not takes_fmu:
            raise ConfigError(
                f"{shown(target)} does not say what there is to learn: "
                f"'fmugym new {path.name} --output task.toml' writes a task file with a guess"
            )
        task = Task.from_dict(tomllib.loads(Proposal(open_model(path)).text()))
        return partial(load, task, **own)
    if path.suffix.lower() == ".toml" or path.is_file():
        return partial(load, Task.draft(path), scenario=scenario, **own)
    module, separator, name = target.partition(":")
    if separator and name.isidentifier() and "/" not in module:
        if scenario is not None:
            raise ConfigError(f"{shown(target)} is no task file and has no scenarios")
        if master is not None:
            raise ConfigError(f"{shown(target)} is no task file and chooses its own master")
        return partial(load, Task.from_dict({"class": target}))
    if scenario is not None:
        own["scenario"] = scenario
    return partial(_registered, target, own)


def player_maker(
    target: str, scenario: str | None = None, master: str | None = None
) -> Callable[..., FMUEnv]:
    """Find the maker for commands that play episodes; see ``maker_of``.

    The function refuses a task whose outputs contradict their limits; see ``require_units``.
    """
    make = maker_of(target, scenario, master)

    def made(**arguments: Any) -> FMUEnv:
        with ExitStack() as stack:
            env = stack.enter_context(closing(make(**arguments)))
            require_units(env)
            stack.pop_all()
        return env

    return made


def _nearest(target: str) -> str:
    """Name the file or id that the user probably meant."""
    folder = Path(target).parent
    files = [str(path) for kind in ("*.toml", "*.fmu") for path in folder.glob(kind)]
    ids = [name for name in gymnasium.registry if name.startswith("fmugym/")]
    near = get_close_matches(target, [*files, *ids], n=1)
    return f" Did you mean {shown(near[0])}?" if near else ""


def scenarios_of(target: str) -> list[str]:
    """The names of the scenarios of a declared task; none for anything else.

    Raises:
        ConfigError: As ``maker_of``.
    """
    path = Path(target)
    if path.is_file() and path.suffix.lower() not in _MODELS:
        task: Task | None = Task.draft(path)
    else:
        with closing(maker_of(target)()) as env:
            task = getattr(env, "task", None)
    return [] if task is None else list(task.begun().child("scenarios").items())


def _registered(
    env_id: str, arguments: dict[str, Any], physical: bool = False, **more: Any
) -> FMUEnv:
    try:
        made = gymnasium.make(env_id, **arguments, **more)
    except gymnasium.error.Error as error:
        why = str(error).partition(" Did you mean")[0]  # files are near, too
        text = f"{shown(env_id)} is no task file, no class and no registered id: {why}"
        raise ConfigError(f"{text}{_nearest(env_id)}") from None
    env = made.unwrapped
    if not isinstance(env, FMUEnv):
        env.close()
        raise ConfigError(f"{shown(env_id)} is no environment of fmugym")
    env.spec = made.spec  # with the time limit, which is a wrapper's
    return env
