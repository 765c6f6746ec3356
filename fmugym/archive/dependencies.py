"""The shared libraries that an FMU needs, looked for before the FMU is loaded."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from fmugym.archive.elf import opened
from fmugym.errors import FMULoadError

__all__ = ["libraries_of", "load_globally", "missing_libraries"]


def missing_libraries(library: Path, provided: Iterable[str] = ()) -> list[str]:
    """Find the shared libraries that a library needs and the system's loader would not find.

    The search is the loader's own: libraries that are loaded already, the library's search path
    (``$ORIGIN`` is its folder), and, by asking the loader, ``LD_LIBRARY_PATH``, the cache of
    ldconfig and the system's folders. What the libraries need that the FMU brings along is looked
    for too. Nothing of the FMU is loaded.

    Args:
        library: The library, extracted.
        provided: Paths or names of libraries that will be loaded before.

    Returns:
        Their names. Empty on systems other than Linux, where the loader has to report them.

    Raises:
        FMULoadError: If a library that the FMU brings along is cut short.
    """
    if sys.platform != "linux":
        return []
    known = set(_names_of(provided))
    missing: list[str] = []
    for name, path in _needed(library):
        if path is None and name not in known:
            missing += [found for found in _not_found(name) if found not in {*missing, *known}]
    return missing


def libraries_of(library: Path) -> list[Path]:
    """The library, and those that it needs and finds among the files of its FMU."""
    return [library, *(path for _, path in _needed(library) if path is not None)]


def _needed(library: Path) -> Iterator[tuple[str, Path | None]]:
    """Each library that is needed, once, and where it is if the FMU brings it along."""
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
            beside = next((f / name for f in folders if (f / name).is_file()), None)
            if beside is not None:
                todo.append((beside, folders))
            yield name, beside


def _names_of(libraries: Iterable[str]) -> Iterator[str]:
    """The names by which the loader knows libraries that are given by name or path."""
    for library in libraries:
        yield os.path.basename(library)
        if os.path.isfile(library):
            with opened(Path(library)) as elf:
                yield elf.soname or ""


def _not_found(name: str) -> list[str]:
    """Ask the loader for a library; returns what is missing: itself, or one that it needs."""
    try:
        ctypes.CDLL(name)
    except OSError as error:
        missing, _, reason = str(error).partition(": ")
        return [missing if reason.startswith("cannot open shared object file") else name]
    return []


def load_globally(path: str) -> None:
    """Load a library so that its symbols and its name serve the libraries loaded after it.

    Args:
        path: An absolute path, or a name that the system's loader finds.

    Raises:
        FMULoadError: If it cannot be loaded.
    """
    try:
        ctypes.CDLL(path, mode=getattr(os, "RTLD_GLOBAL", ctypes.DEFAULT_MODE))
    except OSError as error:
        raise FMULoadError(f"{path!r} of preload cannot be loaded: {error}") from None
