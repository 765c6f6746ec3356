"""Copies of an FMU's library, by which each instance gets global variables of its own."""

from __future__ import annotations

import shutil
from pathlib import Path

from fmugym.archive.loadable import LoadableFMU
from fmugym.errors import FMULoadError
from fmugym.signals import ordinary

__all__ = ["copy_libraries"]


def copy_libraries(fmu: LoadableFMU, folder: Path, count: int) -> list[Path]:
    """Copy the libraries of all parts for each instance; see ``_copy_library``."""
    parts = fmu.parts or (fmu,)
    folders = [part.extract() for part in fmu.parts] or [folder]
    copies = [
        _copy_library(place, Path(part.library), count)
        for part, place in zip(parts, folders, strict=True)
    ]
    return [path for paths in zip(*copies, strict=True) for path in paths]


def _copy_library(folder: Path, library: Path, count: int) -> list[Path]:
    """Copy the library's folder: the system treats files with other paths and inodes as new.

    The copies are in the FMU's temporary folder and are deleted with it.
    """
    paths = []
    try:
        for index in range(count):
            copy = folder / "private" / str(index)
            shutil.copytree(folder / library.parent, copy)
            paths.append(copy / library.name)
    except ordinary(OSError, shutil.Error) as error:
        raise FMULoadError(
            f"{library.name} needs a copy for each instance, but copy {len(paths) + 1} of {count} "
            f"failed: {error}; use fewer instances, or one process for each"
        ) from None
    return paths
