"""What a pool needs in order to load an FMU.

An FMU is native code that runs with all the rights of the process that loads it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from pathlib import Path

import fmpy

from fmugym.archive.bundled import is_bundled
from fmugym.archive.dependencies import load_globally, missing_libraries, stray_libraries
from fmugym.archive.description import ModelDescription
from fmugym.archive.missing import describe_missing
from fmugym.errors import FMULoadError

__all__ = ["ExtractedFMU", "LoadableFMU"]


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
        return all(part.bundled for part in self.parts) if self.parts else is_bundled(self.path)

    def prepare_libraries(self) -> list[Path]:
        """Make the libraries of all parts ready; see ``prepare_library``.

        Returns:
            Their paths; one where there are no parts.
        """
        if not self.parts:
            return [self.prepare_library()]
        return [part.prepare_library() for part in self.parts]

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

    def prepare_library(self) -> Path:
        """Make the FMU's library ready to be loaded into this process.

        Loads the libraries of ``preload`` and those that the FMU brings along where the loader
        does not look, and finds out which others are missing.

        Returns:
            The path of the library, in the folder of ``extract``.

        Raises:
            FMULoadError: As ``extract``; or if one of these libraries cannot be loaded, or others
                are missing; or if it is a library for Windows, which needs a process in Wine.
        """
        if self.in_wine:
            raise FMULoadError(
                f"{self.path.name} has no library for this platform. Environments run its library "
                "for Windows in worker processes in Wine, but this process cannot load it"
            )
        library = self.extract() / self.library
        for path in self.preload:
            load_globally(path)
        missing = missing_libraries(library, self.preload)
        if missing:
            raise FMULoadError(describe_missing(self.path.name, missing))
        for stray in stray_libraries(library):
            load_globally(str(stray))
        return library


class ExtractedFMU(LoadableFMU):
    """An FMU in a folder that somebody else owns, and that stays when this object is closed.

    Args:
        path: The ``.fmu`` file.
        description: The model description.
        preload: See ``LoadableFMU``.
        folder: The folder.
    """

    def __init__(
        self, path: Path, description: ModelDescription, preload: tuple[str, ...], folder: Path
    ) -> None:
        super().__init__(path, description, preload)
        self._folder = folder

    def extract(self) -> Path:
        """Return the folder."""
        return self._folder

    def close(self) -> None:
        """Leave the folder alone."""
