"""Methods of single environments, called where N environments share their attributes.

A single environment of a batch is a view: what a method assigns to it has to be found and taken
over by the batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.vector.arguments import UnknownAttributeError
from fmugym.vector.views import copied_attributes, differs

__all__ = ["TOGETHER", "MethodCall", "attribute", "require_settable"]

TOGETHER: Final = frozenset({"close", "reset", "step"})
"""Methods that one environment cannot do alone."""

_KEPT_FOR_ALL: Final = frozenset(
    {"action", "action_space", "after_end", "config", "done", "fmu", "inputs", "logger"}
    | {"metadata", "observation_space", "out", "parameters", "previous_action", "previous_state"}
    | {"render_mode", "spec", "state", "step_count", "variables"}
)
"""Attributes that ``FMUEnv`` sets itself."""


def require_settable(name: str) -> None:
    """Refuse to set what the environments themselves keep.

    Raises:
        ConfigError: If the name is one of ``FMUEnv``'s own.
    """
    if name in _KEPT_FOR_ALL or hasattr(FMUEnv, name) or name in FMUEnv.__annotations__:
        raise ConfigError(f"{name!r} cannot be set: every environment keeps it itself")


def attribute(env: FMUEnv, name: Any) -> Any:
    """Return an attribute of an environment, or else a parameter of its episode.

    Raises:
        ConfigError: If there is none of this name (it is an ``AttributeError``, too).
    """
    if not isinstance(name, str):
        raise ConfigError(f"the name of an attribute must be text, got {shown(name)}")
    name = str.__str__(name)  # a subclass may have odd methods
    if not hasattr(env, name) and name in env.parameters:
        return env.parameters[name]
    try:
        return getattr(env, name)
    except AttributeError as error:
        raise UnknownAttributeError(str(error)) from None


class MethodCall:
    """Calls a method of one environment, and finds what the method has assigned.

    Args:
        env: A view of the environment; its attributes become copies.
        index: Its number.
    """

    def __init__(self, env: FMUEnv, index: int) -> None:
        self.index = index
        self._env = env
        own = copied_attributes(env)
        own.pop("variables", None)  # these are the view's own already
        vars(env).update(own)
        self._attributes = vars(env) | copied_attributes(env)
        self._same = dict(vars(env))
        self._variables = dict(env.variables)

    def __call__(self, name: str, arguments: Sequence[Any], keywords: Mapping[str, Any]) -> Any:
        """Call the method, or return the attribute if it is none."""
        value = attribute(self._env, name)
        return value(*arguments, **keywords) if callable(value) else value

    def assigned_attributes(self) -> dict[str, Any]:
        """The attributes that the method has assigned, by name.

        Raises:
            ConfigError: If one is the environment's own, or the method changed one in place.
        """
        assigned = {}
        for name, value in vars(self._env).items():
            if name == "variables":
                continue
            if name not in self._same or value is not self._same[name]:
                require_settable(name)
                assigned[name] = value
            elif differs(self._attributes[name], value):
                raise ConfigError(
                    f"a method changes self.{name} in place, which all environments share: let it "
                    "assign a number instead, or make the vector environment with hooks='per_env'"
                )
        return assigned

    def assigned_variables(self) -> dict[str, Any]:
        """The episode variables that the method has assigned, by name."""
        before = self._variables
        return {n: value for n, value in self._env.variables.items() if before[n] is not value}
