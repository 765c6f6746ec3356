"""A cache that lasts between runs: small texts by key in the user's cache folder.

If the folder cannot be read or written, nothing is cached, and no error is raised.
"""

from __future__ import annotations

import logging
import os
import stat
import tempfile
from pathlib import Path
from typing import Final

from fmugym.caching import cache_folder
from fmugym.signals import Ignoring, ordinary

__all__ = ["recall", "remember"]

logger = logging.getLogger(__name__)

_LARGEST: Final = 2**20
"""The largest size of a text in bytes."""

_READ: Final = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Do not follow links, and do not wait for a pipe's writer; Windows has no such flags."""


def recall(key: str) -> str | None:
    """Read the text that was cached under a key; None if there is none.

    Only a regular file of a sensible size is read: a pipe might never end, and a link may lead
    anywhere.
    """
    try:
        handle = os.open(cache_folder() / key, _READ)
        with os.fdopen(handle, "rb") as file:
            status = os.fstat(handle)
            if not stat.S_ISREG(status.st_mode) or status.st_size > _LARGEST:
                return None
            return file.read(_LARGEST).decode()
    except ordinary(OSError, ValueError):
        return None


def remember(key: str, text: str) -> None:
    """Cache a text under a key, which is a file name."""
    try:
        _replace(cache_folder() / key, text)
    except ordinary(OSError) as error:
        logger.debug("nothing is remembered: %s", error)


def _replace(path: Path, text: str) -> None:
    """Replace a file atomically, because another process may be reading or writing it."""
    handle, name = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(name, path)
    except BaseException:
        with Ignoring(OSError):
            os.unlink(name)
        raise
