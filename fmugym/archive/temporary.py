"""Temporary folders with their owner in the name, so that those of killed processes can go."""

from __future__ import annotations

import functools
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

from fmugym.errors import FMULoadError

__all__ = ["make_folder", "remove_folder", "sweep"]

_NAME: Final = re.compile(r"fmugym-(?P<pid>\d+)-(?P<namespace>\d+)-\w+")


def make_folder() -> Path:
    """Make a temporary folder of this process, after a first look for those of dead ones.

    Raises:
        FMULoadError: If the system refuses, for example because the disk is full.
    """
    try:
        sweep()
        return Path(tempfile.mkdtemp(prefix=f"fmugym-{os.getpid()}-{_namespace()}-"))
    except OSError as error:
        raise FMULoadError(f"no temporary folder can be made: {error}") from None


def remove_folder(folder: Path, owner: int) -> None:
    """Remove a folder, unless this process is only a fork of its owner."""
    if os.getpid() == owner:
        shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def sweep() -> None:
    """Remove the folders that killed processes have left; done once in a process."""
    for folder in Path(tempfile.gettempdir()).glob("fmugym-*"):
        name = _NAME.fullmatch(folder.name)
        if name and int(name["namespace"]) == _namespace() and not _is_alive(int(name["pid"])):
            shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def _namespace() -> int:
    """Identify the numbering of processes: containers that share a folder may number them alike."""
    try:
        return os.stat("/proc/self/ns/pid").st_ino
    except OSError:
        return 0


def _is_alive(pid: int) -> bool:
    if sys.platform == "win32":  # asking would end the process there
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
