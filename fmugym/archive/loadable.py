"""What a pool needs in order to load an FMU.

An FMU is native code that runs with all the rights of the process that loads it.
"""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import fmpy

from fmugym.archive import loader
from fmugym.archive.bundled import is_bundled
from fmugym.archive.dependencies import (
    ask_in_a_child,
    describe_missing,
    load_globally,
    missing_libraries,
    stray_libraries,
)
from fmugym.archive.description import ModelDescription
from fmugym.errors import FMULoadError
from fmugym.signals import ordinary

__all__ = ["LoadableFMU", "copy_libraries"]


class LoadableFMU(ABC):
    """What a pool needs in order to load an FMU.

    Args:
        path: The ``.fmu`` file.
        description: The model description.
        preload: Shared libraries to load before the FMU's: absolute paths, or bare names.

    Attributes:
        in_wine: Whether the library is one for Windows that can only run in Wine here.
        isolated: Whether it is a system that shall run in worker processes.
    """

    in_wine = False
    isolated = False

    def __init__(self, path: Path, description: ModelDescription, preload: tuple[str, ...]) -> None:
        self.path = path
        self.description = description
        self.preload = preload

    def __repr__(self) -> str:
        about = self.description
        counts = Counter(variable.causality for variable in about.variables.values())
        told = ", ".join(f"{counts[kind]} {kind}s" for kind in ("input", "output", "parameter"))
        return (
            f"{type(self).__name__}({str(self.path)!r}: {about.model_name}, FMI "
            f"{about.fmi_version}, {told})"
        )

    @property
    def parts(self) -> tuple[LoadableFMU, ...]:
        """The FMUs of a system; none otherwise."""
        return ()

    @property
    def bundled(self) -> bool:
        """Whether it comes with the package."""
        return is_bundled(self.path)

    def libraries_in(self, folder: Path) -> list[tuple[LoadableFMU, Path]]:
        """The FMUs of a system, or this one, and their libraries in a folder like ``extract``'s."""
        if not self.parts:
            return [(self, folder / self.library)]
        return [
            (part, folder / str(number) / part.library) for number, part in enumerate(self.parts)
        ]

    def libraries_before(self, folder: Path) -> list[tuple[str, str]]:
        """The libraries to load before those of the FMUs.

        Args:
            folder: As for ``libraries_in``.

        Returns:
            Names and paths, in the order in which they are to be loaded: those of ``preload``
            without a name, and those that an FMU brings along where the loader does not look. Such
            a one is loaded only if the loader finds none of its name.
        """
        return [
            before
            for fmu, library in self.libraries_in(folder)
            for before in (
                *(("", path) for path in fmu.preload),
                *((path.name, str(path)) for path in stray_libraries(library)),
            )
        ]

    def require_libraries(
        self, folder: Path, ask: Callable[[Sequence[str]], list[str]] = ask_in_a_child
    ) -> None:
        """Require that the loader finds all libraries that those of the FMUs need.

        Args:
            folder: As for ``libraries_in``.
            ask: See ``missing_libraries``.

        Raises:
            FMULoadError: If others are missing, or one that the FMU brings along is cut short.
        """
        for fmu, library in self.libraries_in(folder):
            missing = missing_libraries(library, fmu.preload, ask)
            if missing:
                raise FMULoadError(describe_missing(fmu.path.name, missing))

    def prepare_libraries(self) -> list[Path]:
        """Make the libraries of all FMUs ready to be loaded into this process.

        Loads those that are to be loaded before, and finds out which others are missing.

        Returns:
            Their paths, in the folder of ``extract``; one where there are no parts.

        Raises:
            FMULoadError: As ``extract``; or if one of these libraries cannot be loaded, or others
                are missing; or if it is a library for Windows, which needs a process in Wine.
        """
        if self.in_wine:
            raise FMULoadError(
                f"{self.path.name} has no library for this platform. Environments run its library "
                "for Windows in worker processes in Wine, but this process cannot load it"
            )
        folder = self.extract()
        for path in {path: None for fmu, _ in self.libraries_in(folder) for path in fmu.preload}:
            load_globally(path)
        self.require_libraries(folder, loader.ask)
        for name, path in self.libraries_before(folder):
            if name and loader.ask([name]):
                load_globally(path)
        return [library for _, library in self.libraries_in(folder)]

    @property
    def platform(self) -> str:
        """The folder under ``binaries/`` that this machine needs."""
        if self.in_wine:
            return "x86_64-windows" if self.description.fmi_major_version == 3 else "win64"
        return self.description.platform

    @property
    def library(self) -> str:
        """The place of the library for this machine, relative to the folder of ``extract``."""
        suffix = ".dll" if self.in_wine else fmpy.sharedLibraryExtension
        return f"binaries/{self.platform}/{self.description.model_identifier}{suffix}"

    @abstractmethod
    def extract(self) -> Path:
        """Return the folder that holds the extracted archive."""

    @abstractmethod
    def close(self) -> None:
        """Remove what ``extract`` has made; more than one call is fine."""


def copy_libraries(fmu: LoadableFMU, folder: Path, count: int) -> list[Path]:
    """Copy the libraries of all parts, so that each instance has global variables of its own."""
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
