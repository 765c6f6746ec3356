"""Temporary folders with their owner in the name, so that those of killed processes can go."""

from __future__ import annotations

import atexit
import os
import secrets
import shutil
import tempfile
from pathlib import Path
from typing import Final

from fmugym.caching import own_prefix, sweep
from fmugym.errors import FMULoadError
from fmugym.signals import Ignoring, ordinary

__all__ = ["folder_name", "make_folder", "remove_folder", "remove_rest"]

_made_in: Final[dict[Path, str]] = {}
"""The working directory at the time when each folder was made."""


def folder_name() -> Path:
    """A name for a temporary folder of this process, after a first look for those of dead ones.

    There is no such folder yet. So the caller can see to its removal before it makes it, and no
    signal comes in between.

    Raises:
        FMULoadError: If the system has no folder for temporary files.
    """
    try:
        root = Path(tempfile.gettempdir())
        sweep(root)
        return root / f"{own_prefix()}{secrets.token_hex(8)}"
    except ordinary(OSError) as error:
        raise FMULoadError(f"no temporary folder can be made: {error}") from None


def make_folder(folder: Path) -> None:
    """Make a temporary folder, which only this user can read.

    Raises:
        FMULoadError: If the system refuses, for example because the disk is full.
    """
    try:
        folder.mkdir(0o700)
    except ordinary(OSError) as error:
        raise FMULoadError(f"no temporary folder can be made: {error}") from None
    with Ignoring(OSError):
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
    with Ignoring(OSError):  # an exception of a signal handler comes out, even a TimeoutError
        shutil.rmtree(folder)
    if folder.exists():  # something cannot be removed, such as a library in use on Windows
        shutil.rmtree(folder, ignore_errors=True)
    _made_in.pop(folder, None)


def _leave(folder: Path, directory: str) -> None:
    with Ignoring(OSError):
        if Path.cwd().is_relative_to(folder.resolve()):
            os.chdir(directory)


@atexit.register
def remove_rest() -> None:
    """Remove the folders of this process that a signal at the wrong moment has left."""
    for folder in list(_made_in):
        if folder.name.startswith(own_prefix()):
            _remove(folder)
