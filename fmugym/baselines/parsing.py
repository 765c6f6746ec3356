"""Controllers from a line of text, for the command line."""

from __future__ import annotations

import inspect
import shlex
from typing import Any, Final

from fmugym.baselines.base import Controller
from fmugym.baselines.feedback import PID, Hysteresis
from fmugym.baselines.feedforward import Schedule
from fmugym.errors import ConfigError, shown, unknown_name

__all__ = ["controller_of"]

_KINDS: Final[dict[str, type[Controller]]] = {"hysteresis": Hysteresis, "pid": PID}


def controller_of(text: str) -> Controller:
    """Make the controller that a text names.

    Args:
        text: ``"pid of=T setpoint=21 kp=0.5 ti=14400"``, ``"hysteresis of=T setpoint=T_set
            band=0.5"`` with the arguments of the classes, or ``"schedule 06:00=1 22:00=0.3"``.

    Raises:
        ConfigError: If there is no such controller, or its arguments are wrong.
    """
    try:
        kind, *words = shlex.split(text)
    except ValueError:  # empty, or a quotation mark without its other half
        raise ConfigError(f"expected a controller and its arguments, got {shown(text)}") from None
    if kind == "schedule":
        return Schedule(dict(map(_argument, words)))
    if kind not in _KINDS:
        raise unknown_name("controller", kind, [*_KINDS, "schedule"])
    return _made(_KINDS[kind], dict(map(_argument, words)))


def _argument(word: str) -> tuple[str, Any]:
    name, separator, value = word.partition("=")
    if not separator:
        raise ConfigError(f"expected an argument such as 'kp=0.5', got {shown(word)}")
    try:
        return name, float(value)
    except ValueError:
        return name, value


def _made(cls: type[Controller], arguments: dict[str, Any]) -> Controller:
    parameters = inspect.signature(cls).parameters
    for name in arguments:
        if name not in parameters:
            raise unknown_name(f"argument of {cls.__name__}", name, parameters)
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and name not in arguments:
            raise ConfigError(f"{cls.__name__} needs the argument {name!r}")
    return cls(**arguments)
