"""Libraries that an extra installs and that are imported when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from fmugym.errors import ConfigError

__all__ = ["imported", "installation", "lacking"]


def installation(extra: str) -> str:
    """Say how to install an extra; ``docs/README.md`` says more."""
    return f"install the extra {extra!r}; in a clone of fmugym: pip install '.[{extra}]'"


def lacking(what: str, library: str, extra: str) -> str:
    """Say that a library is missing, and how to install it.

    Args:
        what: What needs it.
        library: Its name.
        extra: The extra that installs it.
    """
    return f"{what} needs {library}, which cannot be imported; {installation(extra)}"


def imported(module: str, extra: str) -> Any:
    """Import a library of an extra, or a module of this package that needs one.

    Raises:
        ConfigError: If it is missing.
    """
    try:
        return import_module(module)
    except ImportError as error:
        needed = error.name or module.removeprefix("fmugym.")
        raise ConfigError(lacking("this", needed.partition(".")[0], extra)) from error
