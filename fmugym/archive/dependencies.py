"""The shared libraries that an FMU needs, looked for before the FMU is loaded."""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from fmugym.archive import loader
from fmugym.archive.elf import opened
from fmugym.errors import FMULoadError
from fmugym.signals import Ignoring, ordinary

__all__ = [
    "ask_in_a_child",
    "libraries_of",
    "load_globally",
    "missing_libraries",
    "stray_libraries",
]

_TIMEOUT_OF_A_CHILD = 60.0
"""Seconds."""


class _Needed(NamedTuple):
    """A library that another one needs.

    Attributes:
        name: Its name.
        path: Where it is among the files of the FMU, or None.
        found: Whether the loader finds it there.
    """

    name: str
    path: Path | None
    found: bool


def missing_libraries(
    library: Path,
    provided: Iterable[str] = (),
    ask: Callable[[Sequence[str]], list[str]] = loader.ask,
) -> list[str]:
    """Find the shared libraries that a library needs and the system's loader would not find.

    The search is the loader's own: libraries that are loaded already, the library's search path
    (``$ORIGIN`` is its folder), and, by asking the loader, ``LD_LIBRARY_PATH``, the cache of
    ldconfig and the system's folders. Libraries beside the FMU's own count as found, since
    ``stray_libraries`` are loaded before. What the libraries need that the FMU brings along is
    looked for too. Nothing of the FMU is loaded.

    Args:
        library: The library, extracted.
        provided: Paths or names of libraries that will be loaded before.
        ask: Asks the loader: ``fmugym.archive.loader.ask`` or ``ask_in_a_child``.

    Returns:
        Their names. Empty on systems other than Linux, where the loader has to report them.

    Raises:
        FMULoadError: If a library that the FMU brings along is cut short.
    """
    if sys.platform != "linux":
        return []
    known = set(_names_of(provided))
    absent = ask([n.name for n in _needed(library) if n.path is None and n.name not in known])
    return list(dict.fromkeys(name for name in absent if name not in known))


def ask_in_a_child(names: Sequence[str]) -> list[str]:
    """Ask the loader of a child process, so that this one loads nothing; otherwise as ``ask``.

    Where the child dies of a library, or cannot be started, nothing counts as missing.
    """
    if not names:
        return []
    with Ignoring(OSError, ValueError, subprocess.SubprocessError):
        done = subprocess.run(
            [sys.executable, "-I", "-S", loader.__file__],
            input=json.dumps(list(names)).encode(),
            capture_output=True,
            timeout=_TIMEOUT_OF_A_CHILD,
            check=True,
        )
        return [str(name) for name in json.loads(done.stdout.splitlines()[-1])]
    return []


def stray_libraries(library: Path) -> list[Path]:
    """Find libraries that an FMU brings along in a folder where the loader does not look.

    Args:
        library: The FMU's library, extracted.

    Returns:
        Their paths, in the order in which they are to be loaded before the FMU's library, unless
        the loader finds others of the same name. Empty on systems other than Linux.
    """
    if sys.platform != "linux":
        return []
    stray = [needed.path for needed in _needed(library) if needed.path and not needed.found]
    return stray[::-1]


def libraries_of(library: Path) -> list[Path]:
    """The library, and those that it needs and finds among the files of its FMU."""
    return [library, *(needed.path for needed in _needed(library) if needed.path)]


def _needed(library: Path) -> Iterator[_Needed]:
    """Each library that is needed, once."""
    seen: set[str] = set()
    todo: list[tuple[Path, list[Path]]] = [(library, [])]
    while todo:
        path, inherited = todo.pop()
        with opened(path) as elf:
            names, folders = elf.needed, elf.search_path(path.parent) + inherited
        for name in names:
            if name in seen:
                continue
            seen.add(name)
            found = _file_in(folders, name)
            there = found or _file_in([library.parent], name)
            if there is not None:
                todo.append((there, folders))
            yield _Needed(name, there, found is not None)


def _file_in(folders: Iterable[Path], name: str) -> Path | None:
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def _names_of(libraries: Iterable[str]) -> Iterator[str]:
    """The names by which the loader knows libraries that are given by name or path."""
    for library in libraries:
        yield os.path.basename(library)
        if os.path.isfile(library):
            with opened(Path(library)) as elf:
                yield elf.soname or ""


def load_globally(path: str) -> None:
    """Load a library so that its symbols and its name serve the libraries loaded after it.

    Args:
        path: An absolute path, or a name that the system's loader finds.

    Raises:
        FMULoadError: If it cannot be loaded.
    """
    try:
        ctypes.CDLL(path, mode=getattr(os, "RTLD_GLOBAL", ctypes.DEFAULT_MODE))
    except ordinary(OSError) as error:
        raise FMULoadError(f"the library {path!r} cannot be loaded: {error}") from None
