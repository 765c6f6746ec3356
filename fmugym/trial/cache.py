"""What is remembered between runs: small texts by key in the user's cache folder.

A folder that cannot be read or written is no error: then nothing is remembered.
"""

from __future__ import annotations

import contextlib
import logging
import os
import stat
import sys
import tempfile
from pathlib import Path
from typing import Final

__all__ = ["cache_folder", "recall", "remember"]

logger = logging.getLogger(__name__)

_LARGEST: Final = 2**20
"""Bytes of a text."""

_READ: Final = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Neither follow a link nor wait for the other end of a pipe; Windows has no such flags."""


def cache_folder() -> Path:
    """The folder: ``FMUGYM_CACHE_DIR``, or ``fmugym`` in the system's place for caches.

    That is ``XDG_CACHE_HOME`` or ``~/.cache``, on macOS ``~/Library/Caches``, on Windows
    ``LOCALAPPDATA``.

    Raises:
        RuntimeError: If the user has no home.
    """
    given = os.environ.get("FMUGYM_CACHE_DIR")
    return Path(given).expanduser() if given else _system_folder() / "fmugym"


def _system_folder() -> Path:
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    name = "LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME"
    given = os.environ.get(name, "")
    return Path(given) if os.path.isabs(given) else Path.home() / ".cache"


def recall(key: str) -> str | None:
    """Find what was remembered under a key, or None.

    Nothing but a regular file of a sensible size is read: a pipe would never end, and a link may
    lead anywhere.
    """
    try:
        handle = os.open(cache_folder() / key, _READ)
        with os.fdopen(handle, "rb") as file:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode) or status.st_size > _LARGEST:
                return None
            return file.read(_LARGEST).decode()
    except (OSError, RuntimeError, ValueError):
        return None


def remember(key: str, text: str) -> None:
    """Remember a text under a key, which is a file name."""
    try:
        folder = cache_folder()
        folder.mkdir(parents=True, exist_ok=True)
        _replace(folder / key, text)
    except (OSError, RuntimeError) as error:
        logger.debug("nothing is remembered: %s", error)


def _replace(path: Path, text: str) -> None:
    """Write a file in one go: another process may read or write it now."""
    handle, name = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise
