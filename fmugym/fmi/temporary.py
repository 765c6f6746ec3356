"""Temporary folders named after their process, so that those of killed processes can go."""

from __future__ import annotations

import atexit
import os
import re
import secrets
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

from fmugym.errors import FMULoadError
from fmugym.files import own_prefix, sweep

__all__ = ["folder_name", "is_plain_path", "make_folder", "remove_folder", "remove_rest"]

_made_in: Final[dict[Path, str]] = {}
"""The working directory at the time when each folder was made."""


_PLAIN: Final = re.compile(r"[A-Za-z0-9_.~/\\:-]{1,150}")
"""Paths that FMUs can be expected to cope with, ours of some 50 letters added."""

_OTHER_ROOTS: Final = (
    (os.environ.get("PUBLIC", ""), os.environ.get("PROGRAMDATA", ""))
    if sys.platform == "win32"
    else ("/tmp", "/var/tmp", "/dev/shm")
)
"""Folders in which all users may make folders."""


def folder_name() -> Path:
    """Name a temporary folder of this process, after a first look for folders of dead ones.

    There is no such folder yet. So the caller can see to its removal before it makes it, and no
    signal comes in between.

    Raises:
        FMULoadError: If the system has no folder for temporary files.
    """
    try:
        root = _root()
        sweep(root)
        return root / f"{own_prefix()}{secrets.token_hex(8)}"
    except OSError as error:
        raise FMULoadError(f"no temporary folder can be made: {error}") from None


def _root() -> Path:
    """The system's folder for temporary files; another one if its path could harm FMUs.

    Many FMUs do not decode the URI of their resources, or have little room for paths.
    """
    usual = Path(tempfile.gettempdir())
    others = _OTHER_ROOTS if not is_plain_path(usual) else ()
    return next((Path(root) for root in others if _is_usable(root)), usual)


def is_plain_path(path: Path) -> bool:
    """Whether a path is short, and its URI has it as it is: no spaces, no special letters."""
    return bool(_PLAIN.fullmatch(str(path)))


def _is_usable(root: str) -> bool:
    """Whether libraries can be extracted to a folder and loaded from there."""
    if not os.path.isdir(root) or not os.access(root, os.W_OK | os.X_OK):
        return False
    mounted = os.statvfs(root).f_flag if hasattr(os, "statvfs") else 0
    return is_plain_path(Path(root)) and not mounted & getattr(os, "ST_NOEXEC", 0)


def make_folder(folder: Path) -> None:
    """Make a temporary folder, which only this user can read.

    Raises:
        FMULoadError: If the system refuses, for example because the disk is full.
    """
    try:
        folder.mkdir(0o700)
    except OSError as error:
        raise FMULoadError(f"no temporary folder can be made: {error}") from None
    with suppress(OSError):
        _made_in[folder] = os.getcwd()


def remove_folder(folder: Path, owner: int) -> None:
    """Remove a folder, unless this process is only a fork of its owner.

    If an FMU has made it the working directory, the one from before is restored.
    """
    if not _is_own(owner):
        return
    try:
        _remove(folder)
    except BaseException:  # such as KeyboardInterrupt: nobody comes back for the rest
        _remove(folder)
        raise


def _is_own(owner: int) -> bool:
    return os.getpid() == owner


def _remove(folder: Path) -> None:
    _leave(folder, _made_in.get(folder, tempfile.gettempdir()))
    with suppress(OSError):
        shutil.rmtree(folder)
    if folder.exists():  # something cannot be removed, such as a library in use on Windows
        shutil.rmtree(folder, ignore_errors=True)
    _made_in.pop(folder, None)


def _leave(folder: Path, directory: str) -> None:
    with suppress(OSError):
        if Path.cwd().is_relative_to(folder.resolve()):
            os.chdir(directory)


@atexit.register
def remove_rest() -> None:
    """Remove the folders of this process that a signal at the wrong moment has left."""
    for folder in list(_made_in):
        if folder.name.startswith(own_prefix()):
            _remove(folder)
