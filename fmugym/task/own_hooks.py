"""The methods that the class of an environment overrides."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, fields
from operator import attrgetter
from typing import Any, Final

__all__ = ["OwnHooks", "is_overridden"]


@dataclass(frozen=True, slots=True)
class OwnHooks:
    """Methods that an environment has from its class or itself, and not from ``FMUEnv``.

    A hook may also be an attribute of the environment, such as a function.
    """

    step: bool
    reset: bool
    update: bool
    is_truncated: bool
    get_observation: bool
    get_info: bool
    goal_reward: bool
    reward_policy: bool
    get_action_space: bool
    get_inputs: bool

    @classmethod
    def of(cls, env: Any, expressed: Container[str]) -> OwnHooks:
        """Compare the methods of an environment with the methods of ``FMUEnv``.

        Args:
            env: The environment.
            expressed: The hooks that evaluate an expression, which count as own ones.
        """
        names = [name if name in _METHODS else f"_{name}" for name in map(_name_of, fields(cls))]
        return cls(*[name in expressed or is_overridden(env, name) for name in names])

    def __contains__(self, hook: str) -> bool:
        """Whether the environment has a hook of its own, by the hook's name."""
        return bool(getattr(self, hook.removeprefix("_")))


_METHODS: Final = ("step", "reset")
_name_of: Final = attrgetter("name")


def is_overridden(env: Any, name: str) -> bool:
    """Whether an environment has another method of this name than ``FMUEnv``."""
    found = getattr(env, name)
    return getattr(found, "__func__", found) is not getattr(env._base, name)
