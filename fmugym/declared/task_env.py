"""The environment of a declared task."""

from __future__ import annotations

import logging
from types import MethodType
from typing import Any, Final, Never

from fmugym.declared.resolved_task import ResolvedTask
from fmugym.declared.task import Task
from fmugym.declared.task_fmu import described
from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, unknown_argument

__all__ = ["TaskEnv"]


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
