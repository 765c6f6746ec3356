"""Dependencies of an FMU: shared libraries and tools that it needs, checked before loading."""

from __future__ import annotations

import ctypes
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

from fmugym.errors import FMULoadError
from fmugym.fmi import system_loader
from fmugym.fmi.binaries import opened

__all__ = [
    "ask_in_a_child",
    "calls_python",
    "describe_missing",
    "libraries_of",
    "load_globally",
    "missing_libraries",
    "missing_tool",
    "note_on",
    "stray_libraries",
]

_TIMEOUT_OF_A_CHILD = 60.0
"""Seconds."""


class _Needed(NamedTuple):
    """A library that another one needs.

    Attributes:
        name: Its name.
        path: Path among the files of the FMU, or None.
        found: Whether the loader finds it there.
    """

    name: str
    path: Path | None
    found: bool


def missing_libraries(
    library: Path,
    provided: Iterable[str] = (),
    ask: Callable[[Sequence[str]], list[str]] = system_loader.ask,
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
        ask: Asks the loader: ``fmugym.fmi.system_loader.ask`` or ``ask_in_a_child``.

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
    with suppress(OSError, ValueError, subprocess.SubprocessError):
        done = subprocess.run(
            [sys.executable, "-I", "-S", system_loader.__file__],
            input=json.dumps(list(names)).encode(),
            capture_output=True,
            timeout=_TIMEOUT_OF_A_CHILD,
            check=True,
        )
        return [str(name) for name in json.loads(done.stdout.splitlines()[-1])]
    return []


def stray_libraries(library: Path) -> list[Path]:
    """Find libraries of an FMU in folders that the loader does not search.

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


@lru_cache(maxsize=64)
def calls_python(library: Path) -> bool:
    """Whether a library calls the Python of its process, which one thread can do at a time.

    Those that pythonfmu makes do. On any system, the names of imported functions are in the file.
    """
    return b"PyGILState_Ensure" in library.read_bytes()


def libraries_of(library: Path) -> list[Path]:
    """The library of an FMU, and the libraries that it needs among the FMU's files."""
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
    except OSError as error:
        raise FMULoadError(f"the library {path!r} cannot be loaded: {error}") from None


_TOOLS: Final = (
    (r"energyplus", "EnergyPlus", "energyplus"),
    (r"overture|into-cps|vdmj", "Java", "java"),
    (r"fmi4j|fmu4j|javafmi", "Java", "java"),
    (r"matlab|simulink", "MATLAB", "matlab"),
    (r"scilab|xcos", "Scilab", "scilab"),
)
"""Pattern of the generation tool, the tool that such an FMU starts, and its program."""

_START_ALWAYS: Final = {"EnergyPlus", "Java"}
"""Tools whose FMUs start them without saying so by ``needsExecutionTool``."""


def missing_tool(generation_tool: str, needs_execution_tool: bool) -> str | None:
    """Name the tool that an FMU starts, unless its program is found.

    Args:
        generation_tool: The tool that made the FMU, the only hint at what it starts.
        needs_execution_tool: The FMU's flag.

    Returns:
        The tool, or None if the FMU starts none or its program is in the search path.
    """
    for pattern, tool, program in _TOOLS:
        if re.search(pattern, generation_tool, re.IGNORECASE):
            needed = needs_execution_tool or tool in _START_ALWAYS
            return tool if needed and shutil.which(program) is None else None
    return (generation_tool or "the tool that exported it") if needs_execution_tool else None


def note_on(library: str) -> str:
    """Advice on a missing library beyond its installation; empty for most."""
    if re.fullmatch(r"libgfortran\.so\.[34]", library):
        return "no current distribution has it; 'fmugym info --repair FMU' makes a replacement"
    return ""


def describe_missing(fmu: str, libraries: Sequence[str]) -> str:
    """Describe the missing libraries of an FMU, and the cure."""
    notes = ((name, note_on(name)) for name in libraries)
    listing = "; ".join(f"{name} ({note})" if note else name for name, note in notes)
    return (
        f"{fmu} needs shared libraries that are not found here: {listing}. Install them, or name "
        "their files in preload=[...]"
    )
