"""Environment of a task, and the loader that makes environments of task files."""

from __future__ import annotations

import logging
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import MethodType
from typing import Any, Final, Never

import gymnasium

from fmugym.checks import check_flag
from fmugym.environment.env import FMUEnv
from fmugym.errors import ArgumentError, ConfigError, reason, shown, unknown_argument, unknown_name
from fmugym.task.resolved_task import ResolvedTask
from fmugym.task.task_entries import Entry
from fmugym.task.task_file import Task
from fmugym.task.task_fmu import described

__all__ = ["TaskEnv", "load"]

_ARGUMENTS: Final = (
    *("config", "log_level", "render_mode", "backend", "isolation", "master", "scenario"),
)


class TaskEnv(FMUEnv):
    """The environment of a task that a file or a dict declares.

    A class for a task with hooks of its own derives from it. Hooks that the class overrides take
    the place of what the task declares.

    Args:
        config: The task: a ``Task``, the path of a TOML file, or a dict with the same keys.
        log_level: Level of the logger, which gets the FMU's messages.
        render_mode: As for ``FMUEnv``.
        backend: As for ``FMUEnv``.
        isolation: As for ``FMUEnv``.
        master: Master algorithm of a system, ``"gauss_seidel"`` or ``"jacobi"``, in the place of
            the one of its SSP archive or of the task.

    Attributes:
        task: The task.
        cost_limits: Limits of the costs of an episode, by name, as the task says.
        unphysical_keys: The keys of the task for which observations or actions are not in its
            units; none in its physical form, which controllers need, see ``Task.physical``.
        expressions: Expressions of the task, of rewards and costs among others, as they are parsed.

    Raises:
        ConfigError: If the task has a mistake or does not fit its FMU. The text tells the file, the
            line and the key.
        FMULoadError: If the FMU cannot be used on this machine.
    """

    def __init__(
        self,
        config: Any,
        log_level: int = logging.WARNING,
        *,
        render_mode: str | None = None,
        backend: Any = None,
        isolation: str | None = None,
        master: str | None = None,
        **unknown: Never,
    ) -> None:
        for name in unknown:
            raise unknown_argument(type(self).__name__, name, _ARGUMENTS)
        self.task = Task.draft(config)
        root = self.task.begun()
        source, description = described(root, master)
        needs_reward = type(self)._reward_policy is FMUEnv._reward_policy
        with root.placing():
            resolved = ResolvedTask(self.task, root, description, needs_reward)
        self.resolved = resolved
        self.cost_limits, self.warm_up = resolved.cost_limits, resolved.warm_up
        self.unphysical_keys, self.expressions = resolved.unphysical_keys, resolved.expressions
        if resolved.warm_up is not None and "_get_inputs" in _own_hooks(type(self)):
            raise self.task.root.child("warm_up").error(
                f"{type(self).__name__} has a _get_inputs of its own, so that the file cannot say "
                "what happens in the warm-up"
            )
        self._observation_names, self._masks = resolved.observation_names, resolved.action_masks
        self._action_names = resolved.action_names
        own = _own_hooks(type(self))
        own |= {"_explain"} if "_reward_policy" in own else set()
        for name, function in resolved.hooks.items():
            if name not in own:
                setattr(self, name, MethodType(function, self))
        self.formulas = resolved.formulas
        with self.task.root.placing():
            super().__init__(
                source,
                resolved.config,
                log_level,
                render_mode=render_mode,
                backend=backend,
                isolation=isolation,
            )

    @property
    def observation_names(self) -> tuple[str, ...] | None:
        """The names of the observation's elements; None if a hook of a class makes it."""
        if "_get_observation" in _own_hooks(type(self)):
            return None
        return self._observation_names

    @property
    def action_names(self) -> tuple[str, ...] | None:
        """The names of the action's elements; None if a hook of a class makes inputs of it."""
        return None if "_get_inputs" in _own_hooks(type(self)) else self._action_names

    def action_masks(self) -> Any:
        """Tell which levels of the actions take effect now, as MaskablePPO of sb3-contrib asks.

        Returns:
            Booleans of shape (levels,), the levels of the first action first. A level is masked if
            the least time on or off keeps its action from being switched to it.

        Raises:
            ConfigError: If an action has no levels.
        """
        if self._masks is None:
            raise ConfigError("action_masks needs 'levels' of each action")
        return self._masks(self)


def _own_hooks(cls: type[TaskEnv]) -> set[str]:
    """The names of everything that classes between ``TaskEnv`` and this one define."""
    classes = cls.__mro__[: cls.__mro__.index(TaskEnv)]
    return {name for one in classes for name in vars(one)}


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
