"""What is remembered between runs: small texts by key in the user's cache folder.

A folder that cannot be read or written is no error: then nothing is remembered.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import tempfile
from pathlib import Path

__all__ = ["cache_folder", "recall", "remember"]

logger = logging.getLogger(__name__)


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
    """Find what was remembered under a key, or None."""
    try:
        return (cache_folder() / key).read_text(encoding="utf-8")
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
