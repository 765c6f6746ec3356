"""The errors that fmugym raises for mistakes and faults it can name.

::

    FMUGymError
    ├── ConfigError       a name, number or type that the user gave does not fit the FMU
    │   └── ArgumentError an argument that a constructor does not have; a ``TypeError`` as well
    ├── FMULoadError      an archive, a model description or a library cannot be used
    ├── SimulationError   an FMI call failed, or a call came out of its order
    └── ContractError     ``fmugym.testing`` found an environment that breaks its contract

Every error takes one argument, its text, and so survives pickling between processes.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Final

__all__ = [
    "ArgumentError",
    "ConfigError",
    "ContractError",
    "FMUGymError",
    "FMULoadError",
    "SimulationError",
    "shown",
    "unknown_argument",
    "unknown_name",
]

_LONGEST: Final = 200
"""Characters of a value that an error shows."""


class FMUGymError(Exception):
    """Base class of all errors of this package."""


class ConfigError(FMUGymError):
    """A configuration, an option or an action does not fit the FMU or the environment."""


class ArgumentError(ConfigError, TypeError):
    """A constructor does not have this argument.

    Callers that try arguments, as Stable-Baselines3 does, expect a ``TypeError`` here.
    """


class FMULoadError(FMUGymError):
    """An FMU cannot be opened, read, loaded or instantiated on this machine."""


class SimulationError(FMUGymError):
    """An FMI function failed, or a method was called at a time when it has no meaning."""


class ContractError(FMUGymError):
    """An environment does not keep what every environment of this package promises."""


def shown(value: object) -> str:
    """Return the ``repr`` of any value for an error, shortened where it is long.

    A value whose own ``repr`` fails is shown by its type.
    """
    try:
        text = repr(value)
    except Exception:  # it is not ours, and an error is being reported already
        return f"an object of type {type(value).__name__}"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ConfigError:
    """Make the error for a name that does not exist.

    Args:
        kind: What the name should have named, for example ``"config key"``.
        name: The name as it was given.
        known: All the names that would have been right.

    Returns:
        The error, with the nearest known name or, where none is near, some of the known names.
    """
    return ConfigError(f"unknown {kind} {shown(name)}; {_hint(name, list(known))}")


def unknown_argument(owner: str, name: str, known: Iterable[str]) -> ArgumentError:
    """Make the error for a keyword argument that a constructor does not have.

    Args:
        owner: The class.
        name: The argument as it was given.
        known: All arguments that the class has.
    """
    hint = _hint(name, list(known))
    return ArgumentError(f"{owner} got an unexpected keyword argument {shown(name)}; {hint}")


def _hint(name: object, known: list[str]) -> str:
    text = name if isinstance(name, str) else shown(name)
    near = difflib.get_close_matches(text[:_LONGEST], known, n=1)
    if near:
        return f"did you mean {near[0]!r}?"
    listing = ", ".join(map(repr, known[:12])) + (", ..." if len(known) > 12 else "")
    return f"known are: {listing or 'none'}"
