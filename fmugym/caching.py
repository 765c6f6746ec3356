"""Where this package keeps files that last between runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path

__all__ = ["cache_folder"]


def cache_folder() -> Path:
    """Return ``FMUGYM_CACHE_DIR``, or else ``fmugym`` in the system's folder for caches.

    The system's folder is ``XDG_CACHE_HOME`` or ``~/.cache``; on macOS ``~/Library/Caches``; on
    Windows ``LOCALAPPDATA``.

    Raises:
        RuntimeError: If the user has no home folder.
    """
    given = os.environ.get("FMUGYM_CACHE_DIR")
    return Path(given).expanduser() if given else _system_folder() / "fmugym"


def _system_folder() -> Path:
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    name = "LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME"
    given = os.environ.get(name, "")
    return Path(given) if os.path.isabs(given) else Path.home() / ".cache"
