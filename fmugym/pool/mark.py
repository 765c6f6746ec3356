"""Marks: files that tell later processes that an FMU has crashed this one.

A crash ends the process at once. Only a signal handler can still write down that it happened
inside an FMU (``native/mark.c``). So each pool that runs an FMU in this process has a file with a
mapped page, which that handler writes. The file is locked as long as its process lives, and removed
when the pool is gone. A file without a lock is left from a process that has ended: with a mark if
the FMU crashed it, without one if it was killed in another way.

There are marks on Linux only, and only if the C extension was built.
"""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final

from fmugym.errors import printable
from fmugym.pool.extension import has_native_pool
from fmugym.pool.process.last_words import describe_exit
from fmugym.signals import Ignoring, ordinary

if sys.platform != "win32":
    import fcntl

__all__ = ["END", "RESET", "STEP", "Mark", "Remains", "calling", "remains_of"]

logger = logging.getLogger(__name__)

_CALLS: Final = (
    "a step",
    "the loading of its library",
    "an instantiation",
    "an initialization",
    "a reading of its outputs",
    "a reset",
    "a copy of its state",
    "a return to a state",
    "its end",
    "no call",
)
"""What an FMU was asked for, in the order of ``native/mark.h``."""

STEP, RESET, END = (_CALLS.index(name) for name in ("a step", "a reset", "its end"))

_NO_CALL: Final = _CALLS.index("no call")
"""The process has ended elsewhere, because its heap was damaged."""

_TEXT: Final = slice(96, 192)
"""What the C library said then."""

_EXIT: Final = 255
"""In the place of a signal: the FMU has called ``exit``."""

_SIZE: Final = 4096


class Mark:
    """A file with a page for the mark of one pool; removed when this object is gone.

    Args:
        folder: Where to make the file.
        key: Stands for the FMU.

    Attributes:
        page: The page, for the C extension.

    Raises:
        OSError: If there can be no mark here.
    """

    def __init__(self, folder: Path, key: str) -> None:
        if not sys.platform.startswith("linux") or not has_native_pool():
            raise OSError("crashes are only noted on Linux, by the C extension")
        from fmugym import _native

        handle, name = tempfile.mkstemp(dir=folder, prefix="new-")
        try:
            os.write(handle, bytes(_SIZE))  # a full disk must show here, not in the handler
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.page = _native.Mark(handle)  # the mapping holds the lock
            path = folder / f"{key}-{os.path.basename(name)}"
            os.replace(name, path)
        except BaseException:
            with Ignoring(OSError):
                os.unlink(name)
            raise
        finally:
            os.close(handle)
        self._remove = weakref.finalize(self, _remove, path, os.getpid())

    @classmethod
    def attempt(cls, folder: Path, key: str) -> Mark | None:
        """Make a mark where that is possible; say at DEBUG why it is not."""
        try:
            return cls(folder, key)
        except ordinary(OSError) as error:
            logger.debug("a crash would not be noted: %s", error)
            return None


def _remove(path: Path, owner: int) -> None:
    if os.getpid() == owner:  # not in a fork, which runs finalizers too
        with Ignoring(OSError):
            path.unlink()


class _Calling:
    """Tells the handler that this thread is inside the FMU."""

    def __init__(self, page: Any, call: int) -> None:
        self._page, self._call = page, call

    def __enter__(self) -> None:
        self._page.begin(self._call)

    def __exit__(self, *_: object) -> None:
        self._page.end()


def calling(mark: Mark | None, call: int) -> AbstractContextManager[None]:
    """A context for calls of an FMU from Python; it may be entered any number of times."""
    return nullcontext() if mark is None else _Calling(mark.page, call)


class Remains:
    """The marks of processes that have ended.

    Attributes:
        crashes: How the FMU has ended its process, one sentence for each crash.
    """

    def __init__(self, paths: list[Path], crashes: list[str]) -> None:
        self._paths, self.crashes = paths, crashes

    def remove(self) -> None:
        """Remove the files."""
        for path in self._paths:
            with Ignoring(OSError):
                path.unlink()


def remains_of(folder: Path, key: str) -> Remains:
    """Find the marks that ended processes have left for an FMU."""
    paths, crashes = [], []
    with Ignoring(OSError):
        for path in sorted(folder.glob(f"{key}-*")):
            for content in _content_of_ended(path):
                paths.append(path)
                crashes += _sentence(content)
    return Remains(paths, crashes)


def _content_of_ended(path: Path) -> Iterator[bytes]:
    """Read a file if no living process holds its lock."""
    with Ignoring(OSError), path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # shared: others may be reading it, too
        yield file.read(_TEXT.stop)


def _sentence(content: bytes) -> list[str]:
    if len(content) < 2 or content[0] == 0 or content[1] >= len(_CALLS):
        return []
    if content[1] == _NO_CALL:
        said = content[_TEXT].partition(b"\0")[0].decode(errors="replace").strip()
        how = describe_exit(-content[0])
        return [
            f"in training, its process ended with {how} outside of its calls because the heap was "
            f"damaged ({printable(said)})"
        ]
    how = "a call of exit" if content[0] == _EXIT else describe_exit(-content[0])
    return [f"in training, it ended its process with {how} in {_CALLS[content[1]]}"]
