"""Where this package keeps files that last between runs."""

from __future__ import annotations

import functools
import logging
import os
import stat
import sys
import tempfile
from itertools import accumulate
from pathlib import Path
from typing import Final

from fmugym.signals import Ignoring

__all__ = ["cache_folder", "is_own", "lasting_folder", "read_file", "replace_file"]

logger = logging.getLogger(__name__)

_OTHERS: Final = stat.S_IWGRP | stat.S_IWOTH

_READ: Final = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Do not follow links, and do not wait for a pipe's writer; Windows has no such flags."""


def cache_folder(*names: str) -> Path:
    """Return ``FMUGYM_CACHE_DIR``, or else ``fmugym`` in the system's folder for caches.

    The system's folder is ``XDG_CACHE_HOME`` or ``~/.cache``; on macOS ``~/Library/Caches``; on
    Windows ``LOCALAPPDATA``. A folder that is missing is made.

    Args:
        names: Of a folder in it.

    Raises:
        OSError: If there can be none, or others may write to it.
    """
    given = os.environ.get("FMUGYM_CACHE_DIR")
    try:
        root = Path(given).expanduser() if given else _system_folder() / "fmugym"
    except RuntimeError as error:  # the user has no home folder
        raise FileNotFoundError(str(error)) from None
    return _private(root, names)


def lasting_folder(*names: str) -> Path:
    """As ``cache_folder``; where there can be none, in the user's own one for temporary files.

    Raises:
        OSError: If there can be none there either.
    """
    with Ignoring(OSError):
        return cache_folder(*names)
    return _private(Path(tempfile.gettempdir(), f"fmugym-{_user()}"), names)


def read_file(path: Path, largest: int) -> bytes:
    """Read a regular file: a pipe might never end, and a link may lead anywhere.

    Args:
        path: The file.
        largest: The most bytes that it may have.

    Raises:
        OSError: If there is none, or it is another thing or too large.
    """
    handle = os.open(path, _READ)
    with os.fdopen(handle, "rb") as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode) or status.st_size > largest:
            raise OSError(f"{path} is no regular file of at most {largest} bytes")
        return file.read(largest)


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file atomically, because another process may be reading or writing it.

    Raises:
        OSError: If the system refuses.
    """
    handle, name = tempfile.mkstemp(dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        with Ignoring(OSError):
            os.unlink(name)
        raise


def is_own(path: Path) -> bool:
    """Whether a file or folder, or a link to it, belongs to the user of this process."""
    return sys.platform == "win32" or path.lstat().st_uid == _user()


def _user() -> int:
    return 0 if sys.platform == "win32" else os.geteuid()


def _private(root: Path, names: tuple[str, ...]) -> Path:
    """Make a folder and those in it, each for this user alone."""
    for folder in accumulate(names, Path.joinpath, initial=root):
        folder.mkdir(0o700, parents=True, exist_ok=True)
        others = sys.platform != "win32" and folder.stat().st_mode & _OTHERS
        if others or not (is_own(folder) and is_own(folder.resolve())):
            _warn(text := f"{folder} is not used because others than its user may write there")
            raise PermissionError(text)
    return folder


@functools.cache
def _warn(text: str) -> None:
    """Warn, but once for each text."""
    logger.warning(text)


def _system_folder() -> Path:
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    name = "LOCALAPPDATA" if sys.platform == "win32" else "XDG_CACHE_HOME"
    given = os.environ.get(name, "")
    return Path(given) if os.path.isabs(given) else Path.home() / ".cache"
