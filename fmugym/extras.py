"""Libraries that an extra installs and that are imported when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from fmugym.errors import ConfigError

__all__ = ["imported"]


def imported(module: str, extra: str) -> Any:
    """Import a library of an extra.

    Raises:
        ConfigError: If it is missing.
    """
    try:
        return import_module(module)
    except ImportError as error:
        needed = module.removeprefix("fmugym.").partition(".")[0]
        raise ConfigError(
            f"this needs {needed}, which cannot be imported; install the extra: "
            f"pip install 'fmugym-toolbox[{extra}]'"
        ) from error
