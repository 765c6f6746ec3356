"""Making environments of task files."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium

from fmugym.checks import check_flag
from fmugym.declared.entries import Entry
from fmugym.declared.task import Task
from fmugym.declared.task_env import TaskEnv
from fmugym.env import FMUEnv
from fmugym.errors import ArgumentError, reason, shown, unknown_name

__all__ = ["load"]


def load(
    config: Any = None,
    *,
    scenario: str | None = None,
    physical: bool = False,
    **arguments: Any,
) -> FMUEnv:
    """Make the environment that a task file declares.

    Args:
        config: The path of a TOML file, a dict with the same keys, or a ``Task``. See
            ``docs/task-file.md``.
        scenario: The name of a scenario of the task, in which the episodes then take place.
        physical: Whether observations and actions are in the units of the task, as controllers
            need them, whatever it says for agents; see ``Task.physical``.
        arguments: Arguments of the environment, such as ``render_mode`` and ``master``; see
            ``TaskEnv``.

    Raises:
        ConfigError: If the task has a mistake or does not fit its FMU. The text tells the file, the
            line and the key.
        FMULoadError: If the FMU cannot be used on this machine.
    """
    given = {"config": config, "scenario": scenario, "physical": physical, **arguments}
    env = _loaded(**given)
    kwargs = {name: one for name, one in given.items() if one is not None and one is not False}
    env.spec = replace(gymnasium.spec("fmugym/FMU-v0"), kwargs=kwargs)
    return env


def _loaded(config: Any, scenario: str | None, physical: bool, **arguments: Any) -> FMUEnv:
    if config is None:
        raise ArgumentError("give the argument 'config': the path of a task file, or a dict")
    task = Task.draft(config)
    if scenario is not None:
        task = task.in_scenario(scenario)
    if check_flag("physical", physical):
        task = task.physical()
    root = task.begun()
    own, is_plain = root.child("arguments"), root.child("class").value is None
    if is_plain and own.value is not None:
        raise own.error("'arguments' are for a task with a 'class'")
    env_class = TaskEnv if is_plain else _class_of(root.child("class"))
    given = {key: entry.value for key, entry in own.items().items()}
    if issubclass(env_class, TaskEnv):
        return env_class(task, **given, **arguments)
    _require_no_more(task, env_class)
    return env_class(**(given | arguments))


def _class_of(entry: Entry) -> type[FMUEnv]:
    found = _imported(entry) if isinstance(entry.value, str) else entry.value
    if not isinstance(found, type) or not issubclass(found, FMUEnv):
        raise entry.error(f"expected 'module:Class' of an environment, got {shown(found)}")
    return found


def _imported(entry: Entry) -> Any:
    """Import the object that ``"module:name"`` names."""
    module, separator, name = entry.value.partition(":")
    if not (separator and module and name):
        raise entry.error(f"expected 'module:Class' of an environment, got {shown(entry.value)}")
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise entry.error(f"{shown(module)} cannot be imported: {error}") from error
        near = unknown_name("module", module, (path.stem for path in sorted(Path().glob("*.py"))))
        raise entry.error(f"{near} (looked in {shown(str(Path.cwd()))}, too)") from None
    except Exception as error:  # a module may do anything
        what = f"{type(error).__name__}: {reason(error)}"
        raise entry.error(f"{shown(module)} cannot be imported: {what}") from error
    if not hasattr(found, name):
        known = [key for key, value in vars(found).items() if isinstance(value, type)]
        raise entry.error(unknown_name(f"class of {module}", name, known))
    return getattr(found, name)


def _require_no_more(task: Task, env_class: type[FMUEnv]) -> None:
    for key in task.document:
        if key not in {"version", "class", "arguments", "description"}:
            raise task.root.child(key).error(
                f"{env_class.__name__} takes 'arguments' only; derive it from fmugym.TaskEnv to "
                f"declare {key!r} in the file"
            )
