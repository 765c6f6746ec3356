"""Methods of single environments, called where N environments share their attributes.

The prototype stands in for each of them in turn: what a method assigns to it has to be found and
taken over by the batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError
from fmugym.task.readings import READINGS, Readings
from fmugym.vector.arguments import UnknownAttributeError

__all__ = ["TOGETHER", "MethodCalls", "attribute", "require_settable", "take_back"]

TOGETHER: Final = frozenset({"close", "reset", "step"})
"""Methods that one environment cannot do alone."""

_KEPT_FOR_ALL: Final = frozenset(READINGS) | {
    *("action_space", "config", "fmu", "logger", "metadata", "observation_space"),
    *("render_mode", "spec"),
}
"""Attributes that ``FMUEnv`` sets itself."""


def require_settable(name: str) -> None:
    """Refuse to set what the environments themselves keep.

    Raises:
        ConfigError: If the name is one of ``FMUEnv``'s own.
    """
    declared = any(name in vars(cls).get("__annotations__", ()) for cls in FMUEnv.__mro__)
    if name in _KEPT_FOR_ALL or hasattr(FMUEnv, name) or declared:
        raise ConfigError(f"{name!r} cannot be set: every environment keeps it itself")


def attribute(env: FMUEnv, name: str) -> Any:
    """Return an attribute of an environment, or else a variable or parameter of its episode.

    Raises:
        ConfigError: If there is none of this name (it is an ``AttributeError``, too).
    """
    if not hasattr(env, name):
        for own in (env.variables, env.parameters):
            if name in own:
                return own[name]
    try:
        return getattr(env, name)
    except AttributeError as error:
        raise UnknownAttributeError(str(error)) from None


def take_back(env: FMUEnv, before: Mapping[str, Any]) -> None:
    """Give an environment the attributes that it had before."""
    now = vars(env)
    for name in [name for name in now if name not in before]:
        del now[name]
    now.update(before)


class MethodCalls:
    """What a method has assigned, which is called for some environments of a batch.

    Attributes:
        attributes: The attributes: by name, values by the number of the environment.
        variables: The episode variables likewise.
    """

    def __init__(self) -> None:
        self.attributes: dict[str, dict[int, Any]] = {}
        self.variables: dict[str, dict[int, Any]] = {}

    def run(
        self,
        env: FMUEnv,
        index: int,
        name: str,
        arguments: Sequence[Any],
        keywords: Mapping[str, Any],
    ) -> Any:
        """Call the method, or return the attribute if it is none.

        Args:
            env: The prototype, which reads the values of this environment. Afterwards it has its
                attributes of before.
            index: The number of this environment.
            name: The name of the method.
            arguments: The arguments of the method by position.
            keywords: Those by name.

        Raises:
            ConfigError: If the method assigns what the environment keeps itself.
        """
        before, readings, variables = dict(vars(env)), Readings.of(env), dict(env.variables)
        try:
            value = attribute(env, name)
            returned = value(*arguments, **keywords) if callable(value) else value
            now = Readings.of(env)
            for reading in READINGS:
                if getattr(readings, reading) is not getattr(now, reading):
                    require_settable(reading)
            for own, value in vars(env).items():
                if own not in before or value is not before[own]:
                    require_settable(own)
                    self.attributes.setdefault(own, {})[index] = value
            for variable, number in env.variables.items():
                if variables[variable] is not number:
                    self.variables.setdefault(variable, {})[index] = number
        finally:
            take_back(env, before)
        return returned
