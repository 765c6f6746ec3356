"""The errors of fmugym.

::

    FMUGymError
    ├── ConfigError       a name, number or type that the user gave does not fit the FMU
    │   └── ArgumentError a constructor does not have this argument; it is a ``TypeError``, too
    ├── FMULoadError      an archive, a model description or a library cannot be used
    ├── SimulationError   an FMI call failed, or a method was called out of order
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

_LONGEST: Final = 120
"""Characters of a value that an error shows, at most."""


class FMUGymError(Exception):
    """Base class of all errors of this package."""


class ConfigError(FMUGymError):
    """A config, an option or an action does not fit the FMU or the environment."""


class ArgumentError(ConfigError, TypeError):
    """A constructor does not have this argument.

    It is a ``TypeError`` for callers that try arguments, as Stable-Baselines3 does.
    """


class FMULoadError(FMUGymError):
    """An FMU cannot be opened, read, loaded or instantiated on this machine."""


class SimulationError(FMUGymError):
    """An FMI function failed, or a method was called out of order."""


class ContractError(FMUGymError):
    """An environment breaks the contract of all environments of this package."""


def shown(value: object) -> str:
    """Return the text that stands for a value in an error.

    Args:
        value: Any object, even one whose ``repr`` fails.

    Returns:
        One printable line of at most 120 characters.
    """
    try:
        text = repr(value)
    except Exception:  # an error is being reported already
        text = f"<{type(value).__name__} without a repr>"
    if "\n" in text:  # an array
        text = " ".join(text.split())
    if not text.isprintable():
        text = text.encode("unicode_escape").decode()
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
