"""Files: their replacement as a whole, and folders for those that last between runs.

Older files stay until the new ones are complete.
"""

from __future__ import annotations

import functools
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import accumulate
from pathlib import Path
from typing import Final

__all__ = [
    "cache_folder",
    "is_own",
    "lasting_folder",
    "own_prefix",
    "read_file",
    "replace_file",
    "replaced",
    "replaced_together",
    "sweep",
    "write_whole",
]


@contextmanager
def replaced_together() -> Iterator[Callable[[Path], Path]]:
    """Replace files together: if one cannot be written, all old ones stay.

    ::

        with replaced_together() as beside:
            model.save(beside(folder / "model.zip"))
            beside(folder / "facts.json").write_text(facts)

    Yields:
        A function that tells for the path of a file where to write it first: a path with the same
        ending. At the end of the block the new files take their places, in the order of its calls.
    """
    parts: dict[Path, Path] = {}

    def beside(path: Path) -> Path:
        path = path.resolve()  # a link stays one
        part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
        parts[part] = path
        return part

    try:
        yield beside
        for part in parts:
            _sync(part)
        for part, path in parts.items():
            part.replace(path)
    finally:
        for part in parts:
            part.unlink(missing_ok=True)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Replace one file.

    Args:
        path: Path of the file.

    Yields:
        Where to write it first.
    """
    with replaced_together() as beside:
        yield beside(path)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file; the one before stays until this one is complete."""
    with replaced(path) as part:
        part.write_bytes(content)


def _sync(path: Path) -> None:
    """Wait until the system has written a file: some systems tell only then that a disk is full."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


logger = logging.getLogger(__name__)

_NAME: Final = re.compile(r"fmugym-(?P<pid>\d+)-(?P<namespace>\d+)-\w+")

_OTHERS: Final = stat.S_IWGRP | stat.S_IWOTH

_READ: Final = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Do not follow links, and do not wait for a pipe's writer; Windows has no such flags."""


def cache_folder(*names: str) -> Path:
    """Return ``FMUGYM_CACHE_DIR``, or else ``fmugym`` in the system's folder for caches.

    The system's folder is ``XDG_CACHE_HOME`` or ``~/.cache``; on macOS ``~/Library/Caches``; on
    Windows ``LOCALAPPDATA``. A folder that is missing is made.

    Args:
        names: Names on the path to a folder in it.

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
    """Cache folder; if there can be none, the user's own folder for temporary files.

    Raises:
        OSError: If there can be none there either.
    """
    with suppress(OSError):
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
    sweep(path.parent)
    handle, name = tempfile.mkstemp(prefix=own_prefix(), dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise


def own_prefix() -> str:
    """Beginning of the names of temporary files and folders of this process."""
    return f"fmugym-{os.getpid()}-{_namespace()}-"


@functools.cache
def sweep(folder: Path) -> None:
    """Remove the remains of this user's killed processes from a folder; once in a process."""
    for path in folder.glob("fmugym-*"):
        name = _NAME.fullmatch(path.name)
        if name and int(name["namespace"]) == _namespace() and not _is_alive(int(name["pid"])):
            with suppress(OSError):  # another process has removed it
                if is_own(path):
                    _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink()


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
    except (ProcessLookupError, OverflowError):  # the number may be anybody's invention
        return False
    except PermissionError:
        return True
    return True


def is_own(path: Path) -> bool:
    """Whether a file or folder, or a link to it, belongs to the user of this process."""
    return sys.platform == "win32" or path.lstat().st_uid == _user()


def _user() -> int:
    return 0 if sys.platform == "win32" else os.geteuid()


def _private(root: Path, names: tuple[str, ...]) -> Path:
    """Make a folder and its missing parents, each for this user alone."""
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
