"""User names and passwords, which do not stand in task files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from fmugym.checks import check_path, require_regular
from fmugym.errors import ConfigError, shown

__all__ = ["credentials", "require_secret"]

_USER: Final = "FMUGYM_PLANT_USER"
_PASSWORD: Final = "FMUGYM_PLANT_PASSWORD"
_OTHERS: Final = 0o077


def require_secret(path: Path) -> None:
    """Refuse a file that others may read.

    Raises:
        ConfigError: If they may, or there is none.
    """
    try:
        require_regular(path)
        mode = path.stat().st_mode & 0o777
    except OSError as error:
        raise ConfigError(f"{shown(str(path))} cannot be read: {error.strerror}") from None
    if os.name == "posix" and mode & _OTHERS:
        raise ConfigError(
            f"{shown(str(path))} has mode {mode:o}, so that others may read it, expected 600: "
            f"chmod 600 {path}"
        )


def credentials(given: str | None) -> tuple[str, str] | None:
    """The user and the password for a plant; None for none.

    Args:
        given: A file with a line for each; None for environment variables.

    Raises:
        ConfigError: If others may read the file, or one of both is missing.
    """
    if given is None:
        found = [os.environ.get(name) for name in (_USER, _PASSWORD)]
        where = f"the environment variables {_USER} and {_PASSWORD}"
    else:
        path = check_path("credentials", given)
        require_secret(path)
        found = [*path.read_text(encoding="utf-8").splitlines(), None, None][:2]
        where = f"the lines of {shown(str(path))}"
    if found == [None, None] and given is None:
        return None
    user, password = found
    if not user or password is None:
        raise ConfigError(f"expected a user and a password in {where}")
    return user, password
