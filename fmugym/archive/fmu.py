"""An FMU file: opened once, checked, extracted to a folder of its own and cleaned up.

Reading the description never executes the FMU. Loading it (``fmugym.fmi``, ``fmugym.pool``) does:
an FMU is native code that runs with all the rights of the process.
"""

from __future__ import annotations

import logging
import math
import os
import weakref
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Final, cast

import fmpy

from fmugym.archive.description import ModelDescription, Variable, read_model_description
from fmugym.archive.safe_zip import ZIP_ERRORS, ArchiveLimits, checked_entries
from fmugym.archive.shared_library import check_library, load_globally, missing_libraries
from fmugym.archive.temporary import make_folder, remove_folder
from fmugym.checks import check_path
from fmugym.errors import ConfigError, FMULoadError, shown

__all__ = ["DEFAULT_PROBE_TIMEOUT", "FMU", "ExtractedFMU", "LoadableFMU"]

logger = logging.getLogger(__name__)

DEFAULT_PROBE_TIMEOUT: Final = 60.0
"""Seconds that the trial of an unknown FMU may take, the start of its process included."""

_NEVER_NEEDED = {"documentation", "sources"}


class LoadableFMU(ABC):
    """What a pool needs to know of an FMU in order to load it.

    Args:
        path: The ``.fmu`` file.
        description: The model description.
        preload: Shared libraries to load before the FMU's: absolute paths, or bare names.
    """

    def __init__(self, path: Path, description: ModelDescription, preload: tuple[str, ...]) -> None:
        self.path = path
        self.description = description
        self.preload = preload

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r})"

    @property
    def platform(self) -> str:
        """The folder under ``binaries/`` that this machine needs."""
        return self.description.platform

    @property
    def library(self) -> str:
        """The name inside the archive of the library that this machine needs."""
        file_name = self.description.model_identifier + fmpy.sharedLibraryExtension
        return f"binaries/{self.platform}/{file_name}"

    @abstractmethod
    def extract(self) -> Path:
        """Return the folder that holds the extracted archive."""

    @abstractmethod
    def close(self) -> None:
        """Remove what ``extract`` has made; calling it again is fine."""

    def prepare_library(self) -> Path:
        """Make the FMU's library ready to be loaded into this process.

        Loads the libraries of ``preload`` and looks for those that the FMU's library needs.

        Returns:
            The path of the library, in the folder of ``extract``.

        Raises:
            FMULoadError: As ``extract``; or if a library of ``preload`` cannot be loaded, or
                others are missing.
        """
        library = self.extract() / self.library
        for path in self.preload:
            load_globally(path)
        missing = missing_libraries(library)
        if missing:
            raise FMULoadError(
                f"{self.path.name} needs shared libraries that are not found here: "
                f"{', '.join(missing)}; install them, or name their files in preload=[...]"
            )
        return library


class ExtractedFMU(LoadableFMU):
    """An FMU in a folder that belongs to somebody else and stays when this object is closed.

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


class FMU(LoadableFMU):
    """An FMU archive and the temporary folder it is extracted to.

    Args:
        path: The ``.fmu`` file.
        limits: What is too large to be opened; by default ``ArchiveLimits()``.
        preload: Shared libraries to be loaded before the FMU's, for symbols or libraries that it
            does not find by itself: paths, or names that the system's loader finds.
        probe_timeout: Seconds that an FMU which is not known yet may take for a first load and step
            in a process of its own; None to go without. See ``fmugym.trial``.

    Attributes:
        path: The file's absolute path.
        description: The model description.
        limits, preload, probe_timeout: As given; ``preload`` a tuple with absolute paths.

    Raises:
        ConfigError: If an argument does not fit.
        FMULoadError: If the file is missing, not a sound FMU archive, or offers no co-simulation.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        limits: ArchiveLimits | None = None,
        preload: Sequence[str | os.PathLike[str]] = (),
        probe_timeout: float | None = DEFAULT_PROBE_TIMEOUT,
    ) -> None:
        file = check_path("the path of an FMU", path).absolute()
        self.limits = ArchiveLimits() if limits is None else limits
        if not isinstance(self.limits, ArchiveLimits):
            raise ConfigError(f"limits must be ArchiveLimits, got {shown(limits)}")
        _check_probe_timeout(probe_timeout)
        self.probe_timeout = probe_timeout
        libraries = _absolute(preload)
        self._entries = checked_entries(file, self.limits)
        super().__init__(file, read_model_description(file, self.limits), libraries)
        self._folder: Path | None = None
        self._remove_folder: weakref.finalize[..., FMU] | None = None
        if self.description.findings:
            logger.info(
                "%s: %d findings in the model description: %s",
                self.path.name,
                len(self.description.findings),
                "; ".join(self.description.findings),
            )

    @classmethod
    def of(cls, source: FMU | str | os.PathLike[str]) -> FMU:
        """Open an FMU of one's own: by its path, or with the arguments of one that is open."""
        if not isinstance(source, FMU):
            return cls(source)
        return cls(
            source.path,
            limits=source.limits,
            preload=source.preload,
            probe_timeout=source.probe_timeout,
        )

    def variable(self, name: str) -> Variable:
        """Look a variable up by name; see ``ModelDescription.variable``."""
        return self.description.variable(name)

    @cached_property
    def platforms(self) -> tuple[str, ...]:
        """The folders under ``binaries/``, which name the platforms the FMU was built for."""
        parts = [PurePosixPath(name).parts for name in self._entries]
        return tuple(sorted({p[1] for p in parts if len(p) > 2 and p[0] == "binaries"}))

    @property
    def runs_here(self) -> bool:
        """Whether the FMU has a library for this platform."""
        return self.library in self._entries

    def extract(self) -> Path:
        """Extract what this machine needs, once, into a temporary folder.

        The folder goes with ``close``, with this object, or with the interpreter.

        Returns:
            The folder.

        Raises:
            FMULoadError: If there is no library for this platform or the archive is damaged.
        """
        if self._folder is not None:
            return self._folder
        if not self.runs_here:
            raise FMULoadError(
                f"{self.path.name} has no library for this platform ({self.library}); "
                f"it was built for: {', '.join(self.platforms) or 'no platform at all'}"
            )
        self._check_library()
        folder = make_folder()
        self._remove_folder = weakref.finalize(self, remove_folder, folder, os.getpid())
        try:
            self._extract_to(folder)
        except BaseException:
            self.close()
            raise
        self._folder = folder
        return folder

    def _check_library(self) -> None:
        """Look at the library where it is: nothing is written of what cannot be loaded."""
        with self._opened() as archive, archive.open(self.library) as file:
            size = archive.getinfo(self.library).file_size
            check_library(cast(BinaryIO, file), size, f"{self.path.name}: {self.library}")

    def _extract_to(self, folder: Path) -> None:
        wanted = [name for name in self._entries if self._needed(PurePosixPath(name))]
        with self._opened() as archive:
            archive.extractall(folder, wanted)
            (folder / "resources").mkdir(exist_ok=True)  # tools pass its path in any case

    @contextmanager
    def _opened(self) -> Iterator[zipfile.ZipFile]:
        try:
            with zipfile.ZipFile(self.path) as archive:
                yield archive
        except ZIP_ERRORS as error:
            raise FMULoadError(f"{self.path.name} cannot be extracted: {error}") from None

    def _needed(self, name: PurePosixPath) -> bool:
        if name.parts[0] == "binaries":
            return len(name.parts) > 2 and name.parts[1] == self.platform
        return name.parts[0] not in _NEVER_NEEDED

    def close(self) -> None:
        """Remove the temporary folder; more than one call is fine."""
        self._folder = None
        if self._remove_folder is not None:
            self._remove_folder()


def _check_probe_timeout(timeout: float | None) -> None:
    number = isinstance(timeout, int | float) and not isinstance(timeout, bool)
    if timeout is not None and not (number and 0 < timeout < math.inf):
        raise ConfigError(
            f"probe_timeout must be positive and finite, or None, got {shown(timeout)}"
        )


def _absolute(libraries: Sequence[str | os.PathLike[str]]) -> tuple[str, ...]:
    """A bare name is left to the system's loader."""
    try:
        paths = [] if isinstance(libraries, str) else [_file_name(one) for one in libraries]
    except Exception:  # a TypeError; or an object whose own methods fail
        paths = []
    if not paths and not (isinstance(libraries, list | tuple) and len(libraries) == 0):
        raise ConfigError(f"preload must be a list of paths, got {shown(libraries)}")
    return tuple(os.path.abspath(path) if os.path.dirname(path) else path for path in paths)


def _file_name(path: str | os.PathLike[str]) -> str:
    """The text of a path that a file can have."""
    encoded = os.fsencode(path)
    if b"\0" in encoded:
        raise ValueError
    return os.fsdecode(encoded)
