"""A zip archive that is checked before anything of it is unpacked, and unpacked within bounds.

A hostile or broken archive could write outside of its folder, fill the disk or the memory, or hold
two files for one place. Archives of some tools are merely untidy: their names have backslashes, a
folder has no entry or two, ``binaries`` is spelled ``Binaries``. Such names are tidied up, and what
was tidied up is told in ``SafeZip.notes``.
"""

from __future__ import annotations

import copy
import io
import os
import posixpath
import re
import stat
import struct
import sys
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Final, cast

from fmugym.checks import KnownArguments, require_regular
from fmugym.errors import FMULoadError, nearest_name, reason
from fmugym.keys import LARGE_COUNT, check_fields, key

__all__ = ["ArchiveLimits", "SafeZip", "check_limit"]

_ZIP_ERRORS: Final = (
    OSError,
    EOFError,
    RuntimeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)
"""Errors of Python's zipfile for a damaged archive."""

_METHODS: Final = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_ENCRYPTED: Final = 1
_SMALL: Final = 16 * 2**20
"""Bytes that may be unpacked whatever the ratio."""
_DIRECTORY_BYTES_PER_ENTRY: Final = 512
_MOST_FOLDERS: Final = 64
"""Folders inside of each other. Windows and Linux refuse the paths of much deeper ones anyway."""
_MOST_LINKS: Final = 8
"""Symbolic links that may point to each other."""
_LONGEST_TARGET: Final = 4096
_LONGEST_QUOTE: Final = 120
"""Characters of a name that an error quotes."""
_STANDARD_FOLDERS: Final = ("binaries", "documentation", "extra", "resources", "sources")
_DEVICE: Final = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_folds_case = sys.platform in {"win32", "darwin"}
_has_devices = sys.platform == "win32"


@dataclass(frozen=True)
class ArchiveLimits(KnownArguments):
    """Limits of the size of an FMU, checked before it is read; see docs/reliability.md.

    Raises:
        ConfigError: If a limit is not a positive integer.
        ArgumentError: If there is no limit of this name; that is a ``TypeError``, too.
    """

    max_entries: int = key(LARGE_COUNT, "Number of files and folders in the archive.", 20_000)
    max_extracted_bytes: int = key(
        LARGE_COUNT,
        "Size of all its files together, uncompressed.",
        4 * 2**30,
        "4 GiB",
    )
    max_ratio: int = key(
        LARGE_COUNT,
        "Ratio of that size to the archive's own, beyond 16 MiB. Zeros reach 1000, the libraries "
        "and tables of FMUs 2 to 20.",
        200,
    )
    max_xml_bytes: int = key(LARGE_COUNT, "Size of `modelDescription.xml`.", 64 * 2**20, "64 MiB")
    max_variables: int = key(
        LARGE_COUNT, "Number of variables; 100,000 take some four seconds to read.", 100_000
    )

    def __post_init__(self) -> None:
        check_fields(self)


class SafeZip:
    """A zip archive whose directory has been read and checked; it is not kept open.

    Args:
        path: The archive.
        limits: Limits of sizes.

    Attributes:
        path, limits: As given.
        files: zipfile's record of each file, by its place: a relative path with slashes, inside of
            the folder to which the archive is extracted.
        folders: The places of the folders that have an entry of their own.
        notes: Descriptions of untidy places.

    Raises:
        FMULoadError: If it is no zip archive, too large, or not sound.
    """

    def __init__(self, path: Path, limits: ArchiveLimits) -> None:
        self.path, self.limits = path, limits
        self.files: dict[str, zipfile.ZipInfo] = {}
        self.folders: set[str] = set()
        self.notes: list[str] = []
        try:
            if not path.is_file():
                raise FMULoadError(f"there is no FMU at {path}{_what_is_there(path)}")
            require_regular(path)
            self._version = _version_of(path)
            entries = _read_directory(path, limits)
        except _ZIP_ERRORS as error:
            raise FMULoadError(
                f"{reason(path.name)} is not an FMU (a zip archive): {reason(error)}"
            ) from None
        self._check_sizes(entries)
        self._links: dict[str, zipfile.ZipInfo] = {}
        for entry in entries:
            self._add(entry)
        if self._links:
            self._follow_links()
            self._check_sizes(self.files.values())
        self._check_folders()

    # Reading the directory

    def _check_sizes(self, entries: Collection[zipfile.ZipInfo]) -> None:
        """Compare the sizes that the directory gives; zipfile never unpacks more of a file."""
        name, limits, count = self.path.name, self.limits, len(entries)
        check_limit(f"{name} has {count} files", count, limits.max_entries, "max_entries")
        size, most = sum(entry.file_size for entry in entries), limits.max_extracted_bytes
        check_limit(f"{name} unpacks to {size} bytes", size, most, "max_extracted_bytes")
        if size > _SMALL:
            ratio = -(-size // self.path.stat().st_size)
            found = f"{name} unpacks to {ratio} times its size"
            check_limit(found, ratio, limits.max_ratio, "max_ratio")

    def _add(self, entry: zipfile.ZipInfo) -> None:
        place = self._place(entry)
        is_folder = entry.filename.endswith(("/", "\\")) or not entry.filename
        if not place and (is_folder or not entry.file_size):  # such as "./"
            return
        if is_folder:
            self.folders.add(place)
            return
        self._check_file(entry, place)
        if stat.S_ISLNK(entry.external_attr >> 16):
            self._links[place] = entry
        elif self._prefers(place, entry):
            self.files[place] = entry

    def _prefers(self, place: str, entry: zipfile.ZipInfo) -> bool:
        """Choose among files of one place as zipfile does: the last one of the exact name."""
        other = self.files.get(place)
        if other is None:
            return True
        exact = other.filename == place and entry.filename != place
        if (other.CRC, other.file_size) != (entry.CRC, entry.file_size):
            used = "the one with exactly this name" if exact else "the last one"
            self._note(f"the archive has several files {_quoted(place)}; {used} is used")
        return not exact

    def _place(self, entry: zipfile.ZipInfo) -> str:
        """Turn the name of an entry into the place of its file."""
        name = entry.filename.replace("\\", "/")
        if name != entry.filename:
            self._note("names in the archive have backslashes; they are taken for slashes")
        if _escapes(name):
            raise self._refusal(entry, "would be written outside of the FMU's own folder")
        if name.count("/") > _MOST_FOLDERS:
            raise self._refusal(entry, f"lies in more than {_MOST_FOLDERS} folders")
        return self._with_standard_case("/".join(PurePosixPath(name).parts))

    def _with_standard_case(self, place: str) -> str:
        """Spell the names that the FMI standard gives as the standard does."""
        first, slash, rest = place.partition("/")
        known = _STANDARD_FOLDERS if slash else (*_STANDARD_FOLDERS, "modelDescription.xml")
        spelled = next((name for name in known if name.casefold() == first.casefold()), first)
        if spelled != first:
            self._note(f"{_quoted(first)} in the archive is taken for {spelled!r}")
        return spelled + slash + rest

    def _check_file(self, entry: zipfile.ZipInfo, place: str) -> None:
        if not place:
            raise self._refusal(entry, "has content but no name")
        if _has_devices and any(_DEVICE.fullmatch(part) for part in place.split("/")):
            raise self._refusal(entry, "has the name of a device of Windows")
        if entry.header_offset < 0:
            raise self._refusal(entry, "is not all there; copy or export the FMU again")
        if entry.flag_bits & _ENCRYPTED:
            raise self._refusal(entry, "is encrypted; pack the archive without a password")
        if entry.compress_type not in _METHODS:
            raise self._refusal(
                entry,
                f"is compressed by method {entry.compress_type}; FMI allows only stored (0) and "
                "deflated (8) files, so pack the archive again",
            )

    def _follow_links(self) -> None:
        """Let each symbolic link stand for the file of the archive that it points to."""
        with self._opened() as archive:
            targets = {place: _link_target(archive, place, e) for place, e in self._links.items()}
        for place, entry in self._links.items():
            target = targets[place]
            for _ in range(_MOST_LINKS):
                target = targets.get(target, target)
            if target not in self.files:
                raise self._refusal(
                    entry,
                    f"is a symbolic link to {_quoted(targets[place])}, not a file of the archive",
                )
            self.files[place] = copy.copy(self.files[target])

    def _check_folders(self) -> None:
        """Find files in the place of folders, and places that this system takes for one.

        Some tools leave out the slash at the end of a folder's name. Such an entry is empty.
        """
        inside = [*self.files, *(f"{folder}/file" for folder in self.folders)]
        above = [str(folder) for place in inside for folder in PurePosixPath(place).parents]
        for folder in dict.fromkeys(above):
            entry = self.files.pop(folder, None)
            if entry is not None and entry.file_size:
                raise self._refusal(entry, "is a file, but other files lie inside of it")
        self._check_case()

    def _check_case(self) -> None:
        seen: dict[str, str] = {}
        for place in self.files if _folds_case else ():
            other = seen.setdefault(place.casefold(), place)
            if other != place:
                raise self._refusal(
                    self.files[place],
                    f"and {_quoted(other)} differ only in case, so that this system cannot hold "
                    "both",
                )

    def _note(self, text: str) -> None:
        if text not in self.notes and len(self.notes) < 20:
            self.notes.append(text)

    def _refusal(self, entry: zipfile.ZipInfo, why: str) -> FMULoadError:
        return FMULoadError(f"{self.path.name} is refused: {_quoted(entry.filename)} {why}")

    # Unpacking

    def read(self, place: str, limit: int) -> bytes:
        """Unpack a file into memory.

        Args:
            place: Its place.
            limit: The most bytes to read, whatever the archive says of its size.

        Returns:
            Its content; one byte more than ``limit`` if it is longer.

        Raises:
            FMULoadError: If it is damaged.
        """
        with self.open(place) as file:
            return _read_at_most(file, limit + 1)

    @contextmanager
    def open(self, place: str) -> Iterator[BinaryIO]:
        """Open a file for reading, as a context.

        Raises:
            FMULoadError: If it is damaged, also where that shows only later in the context.
        """
        with self._opened() as archive, archive.open(self.files[place]) as file:
            yield cast(BinaryIO, file)

    def extract(self, folder: Path, files: Mapping[str, str], folders: Iterable[str] = ()) -> None:
        """Write files and folders.

        Args:
            folder: Target folder.
            files: The place in ``folder`` of each file, by its place in the archive.
            folders: Places in ``folder`` of folders to make, which may stay empty.

        Raises:
            FMULoadError: If a file is damaged or cannot be written.
        """
        with self._opened() as archive:
            for place in folders:
                (folder / place).mkdir(parents=True, exist_ok=True)
            for place, target in files.items():
                entry = self.files[place]
                entry.filename = target  # zipfile replaces the characters that Windows forbids
                archive.extract(entry, folder)

    @contextmanager
    def _opened(self) -> Iterator[zipfile.ZipFile]:
        try:
            if _version_of(self.path) != self._version:  # the parts would not fit together
                raise FMULoadError(
                    f"{self.path.name} was changed after it was opened; open it again"
                )
            with zipfile.ZipFile(self.path) as archive:
                yield archive
        except OSError as error:
            raise FMULoadError(f"{self.path.name} cannot be unpacked: {reason(error)}") from None
        except _ZIP_ERRORS as error:
            raise FMULoadError(
                f"{self.path.name} is damaged: {reason(error)}; copy or export the FMU again"
            ) from None


def _version_of(path: Path) -> tuple[int, int]:
    """Identity of the file at a path, which changes when another one is written there."""
    status = path.stat()
    return status.st_mtime_ns, status.st_size


def _read_directory(path: Path, limits: ArchiveLimits) -> Sequence[zipfile.ZipInfo]:
    most = _DIRECTORY_BYTES_PER_ENTRY * limits.max_entries
    with _BoundedReader(path, most) as file, zipfile.ZipFile(file) as archive:
        return archive.infolist()


class _BoundedReader(io.BufferedReader):
    """Refuses to read more at once than the directory of an archive may have.

    Python's zipfile reads the whole directory, of whatever size, before it can be asked for it.
    """

    def __init__(self, path: Path, most: int) -> None:
        super().__init__(io.FileIO(path))
        self._most = max(most, 2**17)

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > self._most:
            raise zipfile.BadZipFile(
                f"its directory has {size} bytes, the limit is {self._most}; raise max_entries of "
                "ArchiveLimits if you trust it"
            )
        return super().read(size)


def _read_at_most(file: BinaryIO, count: int) -> bytes:
    """Read in pieces: zipfile unpacks up to 2 GiB for one read without a size."""
    pieces = []
    while count > 0 and (piece := file.read(min(count, 2**16))):
        pieces.append(piece)
        count -= len(piece)
    return b"".join(pieces)


def _what_is_there(path: Path) -> str:
    if path.is_dir():
        return ", which is a folder: put its contents into a zip archive"
    if path.exists():
        return ", which is no regular file"
    there = (sorted(one.name for one in path.parent.glob(kind)) for kind in ("*.fmu", "*"))
    near = next(filter(None, (nearest_name(path.name, names) for names in there)), None)
    return "" if near is None else f"; did you mean {near!r}?"


def check_limit(found: str, value: int, limit: int, name: str) -> None:
    """Refuse a size above a limit.

    Args:
        found: Description of the file, with the name of the FMU.
        value: Its size.
        limit: The limit.
        name: The attribute of ``ArchiveLimits`` that sets the limit.

    Raises:
        FMULoadError: If the value is above the limit.
    """
    if value > limit:
        raise FMULoadError(
            f"{found}, the limit is {limit}; if you trust it, raise {name} of ArchiveLimits"
        )


def _escapes(name: str) -> bool:
    """Whether a path is absolute, has a Windows drive, or climbs to a folder above."""
    return name.startswith("/") or name[1:2] == ":" or ".." in name.split("/")


def _link_target(archive: zipfile.ZipFile, place: str, link: zipfile.ZipInfo) -> str:
    """The place that a symbolic link points to, which may be outside of the archive."""
    with archive.open(link) as file:
        target = os.fsdecode(_read_at_most(cast(BinaryIO, file), _LONGEST_TARGET))
    return posixpath.normpath(posixpath.join(posixpath.dirname(place), target))


def _quoted(name: str) -> str:
    """Quote a name of any length."""
    return repr(name if len(name) <= _LONGEST_QUOTE else name[:_LONGEST_QUOTE] + "...")
