"""Locked files, by which the processes of a user agree on what they share.

A lock belongs to an open file. The system releases it when the process that holds it has ended.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from fmugym.signals import Ignoring

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["exclusively", "is_locked", "release", "try_lock"]

_BEYOND: Final = 2**30
"""On Windows, a locked byte cannot be read; no file has one here."""

_PAUSE: Final = 0.01


def try_lock(handle: int) -> bool:
    """Lock an open file, unless somebody else has locked it; returns whether that worked."""
    try:
        if sys.platform == "win32":
            os.lseek(handle, _BEYOND, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def release(handle: int) -> None:
    """Unlock a file, also for forks of this process that still have it open, and close it."""
    with Ignoring(OSError):
        if sys.platform == "win32":
            os.lseek(handle, _BEYOND, os.SEEK_SET)
            msvcrt.locking(handle, msvcrt.LK_UNLCK, 1)
        else:
            fcntl.flock(handle, fcntl.LOCK_UN)
    os.close(handle)


def is_locked(path: Path) -> bool:
    """Whether a living process has locked a file."""
    try:
        handle = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    try:
        return not try_lock(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def exclusively(path: Path) -> Iterator[None]:
    """Let one thread of one process at a time into this context.

    Args:
        path: A file that everybody locks meanwhile; made if it is missing.

    Raises:
        OSError: If it cannot be made or locked.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        while not try_lock(handle):
            time.sleep(_PAUSE)
        yield
    finally:
        release(handle)
