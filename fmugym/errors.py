"""Exceptions of fmugym.

::

    FMUGymError
    ├── ConfigError       a name, number or type that the user gave does not fit the FMU
    │   ├── ArgumentError a constructor does not have this argument; it is a ``TypeError``, too
    │   ├── UnknownParameterError
    │   │                 ``env.parameters`` has no such name; it is a ``KeyError``, too
    │   └── TaskError     a declared task has a mistake; the text says where
    │       └── ConsequenceError
    │                     it follows from another mistake only, which is told instead
    ├── FMULoadError      an archive, a model description or a library cannot be used
    ├── SimulationError   an FMI call failed, or a method was called out of order
    │   └── LicenceError  an FMU got no licence; it is a ``FMULoadError``, too
    └── ContractError     ``fmugym.environment.env_checker`` found an environment that breaks its
    contract

Every error takes one argument, its text, and so survives pickling between processes. The text is
shown with ``printable``: it may quote an FMU.
"""

from __future__ import annotations

import difflib
import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

__all__ = [
    "ArgumentError",
    "ConfigError",
    "ConsequenceError",
    "ContractError",
    "FMUGymError",
    "FMULoadError",
    "LicenceError",
    "SimulationError",
    "TaskError",
    "UnknownParameterError",
    "first_of",
    "missing_file",
    "nearest_name",
    "plain",
    "printable",
    "reading_file",
    "reason",
    "shown",
    "unknown_argument",
    "unknown_name",
    "warn_once",
]

_LONGEST: Final = 120
"""Characters of a value that an error shows, at most."""

_LONGEST_REASON: Final = 400
"""Characters of another error that an error quotes, at most."""

_MOST_NAMES: Final = 5
"""Names that a text lists, at most."""

_warned: Final[set[str]] = set()


def printable(text: object) -> str:
    r"""Escape characters that a terminal may obey or a log may take for a new line.

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


def plain(text: object) -> str:
    """Bring a text of a foreign file into one line, with letters of any language.

    Other characters are escaped: a terminal may obey them.
    """
    return printable(" ".join(str(text).split()))


class FMUGymError(Exception):
    """Base class of all errors of this package."""

    def __str__(self) -> str:
        return printable(super().__str__())


class ConfigError(FMUGymError):
    """A config, an option or an action does not fit the FMU or the environment."""


class ArgumentError(ConfigError, TypeError):
    """A constructor does not have this argument.

    It is a ``TypeError`` for callers that try arguments, as Stable-Baselines3 does.
    """


class UnknownParameterError(ConfigError, KeyError):
    """``env.parameters`` has no such name. It is a ``KeyError``, as with any other mapping."""

    def __str__(self) -> str:
        return printable(self.args[0])


class TaskError(ConfigError):
    """A declared task has mistakes. Each line begins with the file, the line in it and the keys."""

    def __str__(self) -> str:
        return "\n".join(map(printable, str(self.args[0]).split("\n")))


class ConsequenceError(TaskError):
    """A value cannot be had because of a mistake that is noted already."""


class FMULoadError(FMUGymError):
    """An FMU cannot be opened, read, loaded or instantiated on this machine."""


class SimulationError(FMUGymError):
    """An FMI function failed, or a method was called out of order."""


class LicenceError(SimulationError, FMULoadError):
    """An FMU got no licence when it was instantiated or initialized, by its own words.

    Or other environments of this process have all instances that ``max_instances`` allows.
    """


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
    text = printable(text)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def first_of(names: Sequence[str]) -> str:
    """Name the first of some names in a message, and count the others."""
    few = ", ".join(names[:_MOST_NAMES]) or "nothing"
    more = len(names) - _MOST_NAMES
    return printable(f"{few} and {more} more" if more > 0 else few)


def reason(error: object) -> str:
    """Return the text of an error of another library, which may quote any amount of a file."""
    text = str(error)
    return text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]}..."


@contextmanager
def reading_file(failure: str) -> Iterator[None]:
    """While a file is read, make a ``ConfigError`` of whatever a damaged one raises.

    Args:
        failure: Its text, to which the reason is added: ``"the agent in ... cannot be read"``.
    """
    try:
        yield
    except FMUGymError:
        raise
    except Exception as error:  # a damaged file may raise anything
        raise ConfigError(f"{failure}: {reason(error)}") from error


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ConfigError:
    """Make the error for a name that does not exist.

    Args:
        kind: Kind of the named thing, for example ``"config key"``.
        name: The name that was given.
        known: All valid names.

    Returns:
        The error. It suggests the nearest known name, or lists known names if none is near.
    """
    return ConfigError(f"unknown {kind} {shown(name)}; {_hint(name, known)}")


def missing_file(kind: str, path: Path, pattern: str) -> ConfigError:
    """Make the error for a file that does not exist.

    Args:
        kind: As for ``unknown_name``.
        path: The file.
        pattern: What it may have been meant to be, as a glob in its folder.
    """
    near = sorted(file.name for file in path.parent.glob(pattern))
    if near:
        return ConfigError(
            f"{unknown_name(kind, path.name, near)} (looked in {shown(str(path.parent))})"
        )
    others = f"which has no {pattern}" if path.parent.is_dir() else "which does not exist"
    return ConfigError(
        f"there is no {kind} {shown(path.name)} in {shown(str(path.parent))}, {others}; give "
        "another path"
    )


def unknown_argument(owner: str, name: str, known: Iterable[str]) -> ArgumentError:
    """Make the error for a keyword argument that a constructor does not have.

    Args:
        owner: The class.
        name: The argument as it was given.
        known: All arguments that the class has.
    """
    text = f"{owner} got an unexpected keyword argument {shown(name)}"
    return ArgumentError(f"{text}; {_hint(name, known)}")


def _hint(name: object, known: Iterable[str]) -> str:
    """Suggest the nearest name, or else list the first of them; sets have no order of their own."""
    names = sorted(known) if isinstance(known, set | frozenset) else list(dict.fromkeys(known))
    near = nearest_name(name, names)
    if near is not None:
        return f"did you mean {near!r}?"
    listing = ", ".join(map(repr, names[:12])) + (", ..." if len(names) > 12 else "")
    return f"known are: {listing or 'none'}"


def warn_once(logger: logging.Logger, text: str) -> None:
    """Warn, unless this process has done so with the same text."""
    if text not in _warned:
        _warned.add(text)
        logger.warning("%s", text)


def nearest_name(name: object, known: Sequence[str]) -> str | None:
    """The known name that is nearest to another one, upper or lower case; None if none is near."""
    text = name if isinstance(name, str) else shown(name)
    near = difflib.get_close_matches(text[:_LONGEST], known, n=1)
    if near:
        return near[0]
    lower = {one.lower(): one for one in reversed(known)}
    near = difflib.get_close_matches(text[:_LONGEST].lower(), lower, n=1)
    return lower[near[0]] if near else None
