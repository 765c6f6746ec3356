"""The errors that fmugym raises for mistakes and faults it can name.

::

    FMUGymError
    ├── ConfigError       a name, number or type that the user gave does not fit the FMU
    ├── FMULoadError      an archive, a model description or a library cannot be used
    ├── SimulationError   an FMI call failed, or a call came out of its order
    └── ContractError     ``fmugym.testing`` found an environment that breaks its contract

Every error takes one argument, its text, and so survives pickling between processes. The text is
shown with ``printable``: it may quote an FMU.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = [
    "ConfigError",
    "ContractError",
    "FMUGymError",
    "FMULoadError",
    "SimulationError",
    "printable",
    "shown",
    "unknown_name",
]

_LONGEST_SHOWN = 120


def printable(text: object) -> str:
    r"""Escape what a terminal may obey or a log may take for a line of its own.

    Names, descriptions and messages of an FMU are foreign texts. Every exit uses this function:
    errors, logs, infos and the command line.

    Args:
        text: A text, or an object that is turned into one.

    Returns:
        The text on one line. Letters of all languages stay. Control characters, line breaks,
        marks that reverse the direction of writing and the like become ``\x1b``, ``\n`` and
        so on.
    """
    line = str(text)
    if line.isprintable():
        return line
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


class FMUGymError(Exception):
    """Base class of all errors of this package."""

    def __str__(self) -> str:
        return printable(super().__str__())


class ConfigError(FMUGymError):
    """A configuration, an option or an action does not fit the FMU or the environment."""


class FMULoadError(FMUGymError):
    """An FMU cannot be opened, read, loaded or instantiated on this machine."""


class SimulationError(FMUGymError):
    """An FMI function failed, or a method was called at a time when it has no meaning."""


class ContractError(FMUGymError):
    """An environment does not keep what every environment of this package promises."""


def shown(value: object) -> str:
    """Return the text that stands for a value in an error message.

    Args:
        value: Any object, even one whose ``repr`` fails.

    Returns:
        One printable line of at most 120 characters.
    """
    try:
        text = repr(value)
    except Exception:
        text = f"<{type(value).__name__} without a text>"
    if "\n" in text:  # an array
        text = " ".join(text.split())
    text = printable(text)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 3]}..."


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ConfigError:
    """Make the error for a name that does not exist.

    Args:
        kind: What the name should have named, for example ``"config key"``.
        name: The name that was given.
        known: All valid names.

    Returns:
        The error. It suggests the nearest known name, or lists known names if none is near.
    """
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1) if isinstance(name, str) else []
    if near:
        return ConfigError(f"unknown {kind} {shown(name)}; did you mean {near[0]!r}?")
    listing = ", ".join(map(repr, names[:12])) + (", ..." if len(names) > 12 else "")
    return ConfigError(f"unknown {kind} {shown(name)}; known are: {listing or 'none'}")
