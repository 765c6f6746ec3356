"""An FMU file: opened once, checked, extracted to a folder of its own and cleaned up.

Reading the description never executes the FMU. Loading it (``fmugym.adapters``) does: an FMU is
native code that runs with all the rights of the process.
"""

from __future__ import annotations

import logging
import os
import shutil
import stat
import tempfile
import weakref
import zipfile
from collections import Counter
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Final

import fmpy

from fmugym.errors import FMULoadError
from fmugym.model_description import (
    ZIP_ERRORS,
    ModelDescription,
    Variable,
    read_model_description,
)

__all__ = ["FMU"]

logger = logging.getLogger(__name__)

MAX_ENTRIES: Final = 20_000
"""Largest number of files in an archive."""

MAX_EXTRACTED_BYTES: Final = 4 * 2**30
"""Largest size of an archive's files together, uncompressed."""

MAX_RATIO: Final = 1000
"""Largest ratio of uncompressed to compressed size; deflate reaches 1032 on zeros."""

_NEVER_NEEDED = {"documentation", "sources"}

_MAGIC = {
    ".so": (b"\x7fELF",),
    ".dll": (b"MZ",),
    ".dylib": (b"\xcf\xfa\xed\xfe", b"\xca\xfe\xba\xbe", b"\xce\xfa\xed\xfe"),
}
_ELF_MACHINES = {3: "x86", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}


class FMU:
    """An FMU archive and the temporary folder it is extracted to.

    Args:
        path: The ``.fmu`` file.

    Attributes:
        path: The file's absolute path.
        description: The model description.

    Raises:
        FMULoadError: If the file is missing, not a sound FMU archive, or offers no co-simulation.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).absolute()
        self._entries = _checked_entries(self.path)
        self.description: ModelDescription = read_model_description(self.path)
        self._folder: Path | None = None
        self._remove_folder: weakref.finalize[..., FMU] | None = None
        if self.description.findings:
            logger.info(
                "%s: %d findings in the model description: %s",
                self.path.name,
                len(self.description.findings),
                "; ".join(self.description.findings),
            )

    def __repr__(self) -> str:
        return f"FMU({str(self.path)!r})"

    def variable(self, name: str) -> Variable:
        """Look a variable up by name; see ``ModelDescription.variable``."""
        return self.description.variable(name)

    @cached_property
    def platforms(self) -> tuple[str, ...]:
        """The folders under ``binaries/``, which name the platforms the FMU was built for."""
        parts = [PurePosixPath(name).parts for name in self._entries]
        return tuple(sorted({p[1] for p in parts if len(p) > 2 and p[0] == "binaries"}))

    @property
    def platform(self) -> str:
        """The folder under ``binaries/`` that this machine needs."""
        return self.description.platform

    @property
    def library(self) -> str:
        """The name inside the archive of the library that this machine needs."""
        file_name = self.description.model_identifier + fmpy.sharedLibraryExtension
        return f"binaries/{self.platform}/{file_name}"

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
        folder = Path(tempfile.mkdtemp(prefix="fmugym-"))
        self._remove_folder = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        try:
            self._extract_to(folder)
            _check_library(folder / self.library)
        except BaseException:
            self.close()
            raise
        self._folder = folder
        return folder

    def _extract_to(self, folder: Path) -> None:
        wanted = [name for name in self._entries if self._needed(PurePosixPath(name))]
        try:
            with zipfile.ZipFile(self.path) as archive:
                archive.extractall(folder, wanted)
        except ZIP_ERRORS as error:
            raise FMULoadError(f"{self.path.name} cannot be extracted: {error}") from None
        (folder / "resources").mkdir(exist_ok=True)  # tools pass its path even where it is absent

    def _needed(self, name: PurePosixPath) -> bool:
        if name.parts[0] == "binaries":
            return len(name.parts) > 2 and name.parts[1] == self.platform
        return name.parts[0] not in _NEVER_NEEDED

    def close(self) -> None:
        """Remove the temporary folder; more than one call is fine."""
        self._folder = None
        if self._remove_folder is not None:
            self._remove_folder()


def _checked_entries(path: Path) -> tuple[str, ...]:
    """Check every entry of the archive before anything of it is written."""
    if not path.is_file():
        raise FMULoadError(f"there is no FMU at {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except ZIP_ERRORS as error:
        raise FMULoadError(f"{path.name} is not an FMU (a zip archive): {error}") from None
    _check_sizes(path, entries)
    for entry in entries:
        _check_entry(path, entry)
    names = [entry.filename for entry in entries if not entry.is_dir()]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise FMULoadError(f"{path.name} has two files of one name: {twice[0]!r}")
    return tuple(names)


def _check_sizes(path: Path, entries: list[zipfile.ZipInfo]) -> None:
    if len(entries) > MAX_ENTRIES:
        raise FMULoadError(f"{path.name} has {len(entries)} files, the limit is {MAX_ENTRIES}")
    size = sum(entry.file_size for entry in entries)
    if size > MAX_EXTRACTED_BYTES:
        raise FMULoadError(
            f"{path.name} unpacks to {size} bytes, the limit is {MAX_EXTRACTED_BYTES}"
        )
    if size > 2**20 and size > MAX_RATIO * path.stat().st_size:
        raise FMULoadError(
            f"{path.name} unpacks to more than {MAX_RATIO} times its size; it is not a sound FMU"
        )


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = PurePosixPath(entry.filename)
    if not name.parts:
        raise FMULoadError(f"{path.name} has a file without a name: {entry.filename!r}")
    if name.is_absolute() or ".." in name.parts or "\\" in entry.filename or ":" in entry.filename:
        raise FMULoadError(f"{path.name} has a file outside of its own folder: {entry.filename!r}")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise FMULoadError(f"{path.name} has a symbolic link: {entry.filename!r}")
    if entry.flag_bits & 1:
        raise FMULoadError(f"{path.name} is encrypted: {entry.filename!r}")


def _check_library(library: Path) -> None:
    """Look at the header: loading a foreign or cut library fails with a misleading text."""
    with library.open("rb") as file:
        header = file.read(64)
    if not header.startswith(_MAGIC[library.suffix]):
        raise FMULoadError(f"{library.name} is not a shared library of this system")
    if library.suffix == ".so":
        _check_elf(library, header)


def _check_elf(library: Path, header: bytes) -> None:
    if len(header) < 64:
        raise FMULoadError(f"{library.name} is cut short ({len(header)} bytes)")
    machine = int.from_bytes(header[18:20], "little")
    built_for = _ELF_MACHINES.get(machine, f"ELF machine {machine}")
    if built_for != fmpy.architecture:
        raise FMULoadError(
            f"{library.name} was built for {built_for}, this process runs on {fmpy.architecture}"
        )
    section_table = int.from_bytes(header[40:48], "little")
    section_size = int.from_bytes(header[58:60], "little")
    count = int.from_bytes(header[60:62], "little")
    if section_table + section_size * count > library.stat().st_size:
        raise FMULoadError(f"{library.name} is cut short ({library.stat().st_size} bytes)")
