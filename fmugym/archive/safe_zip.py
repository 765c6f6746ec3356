"""What a zip archive is checked for before anything of it is unpacked.

Unpacking a hostile or broken archive can write outside of its folder, fill the disk, or take what
one file says for another. So its directory is read first, within bounds, and compared with the
headers in front of the files.
"""

from __future__ import annotations

import io
import lzma
import stat
import struct
import sys
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Final

from fmugym.checks import check_count
from fmugym.errors import FMULoadError

__all__ = ["ZIP_ERRORS", "ArchiveLimits", "checked_entries", "over_limit"]

ZIP_ERRORS = (
    OSError,
    EOFError,
    RuntimeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
)
"""What Python's zipfile raises for a damaged archive."""

_METHODS: Final = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
_LOCAL_HEADER: Final = struct.Struct("<4s22xHH")
_ENCRYPTED: Final = 1
_SMALL: Final = 16 * 2**20
"""Bytes that may be unpacked whatever the ratio."""
_DIRECTORY_BYTES_PER_ENTRY: Final = 512
_folds_case = sys.platform in {"win32", "darwin"}


@dataclass(frozen=True)
class ArchiveLimits:
    """How large an FMU may be before it is refused unread.

    Attributes:
        max_entries: Number of files in the archive.
        max_extracted_bytes: Size of all its files together, uncompressed.
        max_ratio: Ratio of that size to the archive's own, beyond 16 MiB. Zeros reach 1000, the
            libraries and tables of FMUs 2 to 20.
        max_xml_bytes: Size of ``modelDescription.xml``.
        max_variables: Number of variables; 100,000 take some four seconds to read.

    Raises:
        ConfigError: If a limit is not a positive integer.
    """

    max_entries: int = 20_000
    max_extracted_bytes: int = 4 * 2**30
    max_ratio: int = 200
    max_xml_bytes: int = 64 * 2**20
    max_variables: int = 100_000

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            object.__setattr__(self, field.name, check_count(field.name, value, sys.maxsize))


def checked_entries(path: Path, limits: ArchiveLimits) -> tuple[str, ...]:
    """Check every entry of an archive; nothing is unpacked.

    Args:
        path: The archive.
        limits: What is too large.

    Returns:
        The names of its files, without the folders.

    Raises:
        FMULoadError: If it is no zip archive, too large, or not sound.
    """
    try:
        if not path.is_file():
            raise FMULoadError(f"there is no FMU at {path}")
        return _checked_files(path, limits)
    except ZIP_ERRORS as error:
        raise FMULoadError(f"{path.name} is not an FMU (a zip archive): {error}") from None


def _checked_files(path: Path, limits: ArchiveLimits) -> tuple[str, ...]:
    most = _DIRECTORY_BYTES_PER_ENTRY * limits.max_entries
    with _BoundedReader(path, most) as file, zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        _check_sizes(path, entries, limits)
        for entry in entries:
            _check_entry(path, entry)
        _check_layout(path, file, entries, archive.start_dir)
    files = [entry.filename for entry in entries if not entry.is_dir()]
    _check_collisions(path, files)
    return tuple(files)


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
                "ArchiveLimits if that is right"
            )
        return super().read(size)


def _check_sizes(path: Path, entries: Sequence[zipfile.ZipInfo], limits: ArchiveLimits) -> None:
    _check_limit(path, "has {} files", len(entries), limits, "max_entries")
    size = sum(entry.file_size for entry in entries)
    _check_limit(path, "unpacks to {} bytes", size, limits, "max_extracted_bytes")
    if size > _SMALL:
        ratio = -(-size // path.stat().st_size)
        _check_limit(path, "unpacks to {} times its size", ratio, limits, "max_ratio")


def _check_limit(path: Path, what: str, value: int, limits: ArchiveLimits, name: str) -> None:
    limit = getattr(limits, name)
    if value > limit:
        raise over_limit(f"{path.name} {what.format(value)}", limit, name)


def over_limit(found: str, limit: int, name: str) -> FMULoadError:
    """Make the error for what is too large.

    Args:
        found: What is how large, with the name of the FMU.
        limit: What would have been allowed.
        name: The attribute of ``ArchiveLimits`` that says so.
    """
    return FMULoadError(
        f"{found}, the limit is {limit}; if you trust it, raise {name} of ArchiveLimits"
    )


def _check_entry(path: Path, entry: zipfile.ZipInfo) -> None:
    name = PurePosixPath(entry.filename)
    if not name.parts:
        raise FMULoadError(f"{path.name} has a file without a name: {entry.filename!r}")
    if _escapes(entry.filename, name):
        raise FMULoadError(f"{path.name} has a file outside of its own folder: {entry.filename!r}")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise FMULoadError(f"{path.name} has a symbolic link: {entry.filename!r}; pack its target")
    if entry.flag_bits & _ENCRYPTED:
        raise FMULoadError(f"{path.name} is encrypted: {entry.filename!r}; pack it without")
    if entry.compress_type not in _METHODS:
        raise FMULoadError(
            f"{path.name}: {entry.filename!r} is compressed by method {entry.compress_type}; FMI "
            "allows stored (0) and deflated (8) files, pack it anew"
        )


def _escapes(text: str, name: PurePosixPath) -> bool:
    """Absolute and upward paths, and what Windows would take for a drive, device or stream."""
    return name.is_absolute() or ".." in name.parts or "\\" in text or ":" in text


def _check_layout(
    path: Path, file: BinaryIO, entries: Sequence[zipfile.ZipInfo], directory: int
) -> None:
    """Each file's bytes lie in front of the next one's: no bytes are unpacked twice."""
    inner = sorted(entries, key=lambda entry: entry.header_offset)
    starts = [entry.header_offset for entry in inner[1:]] + [directory]
    for entry, limit in zip(inner, starts, strict=True):
        end = _data_start(path, file, entry) + entry.compress_size
        if end > directory:
            raise FMULoadError(f"{path.name} is cut short: {entry.filename!r} is not all there")
        if end > limit:
            raise FMULoadError(
                f"{path.name} has files that overlap: {entry.filename!r} and the next one share "
                "bytes; it is not a sound archive"
            )


def _data_start(path: Path, file: BinaryIO, entry: zipfile.ZipInfo) -> int:
    file.seek(entry.header_offset)
    header = file.read(_LOCAL_HEADER.size)
    if len(header) < _LOCAL_HEADER.size or not header.startswith(b"PK\x03\x04"):
        raise FMULoadError(f"{path.name} is damaged: {entry.filename!r} is not where it should be")
    _, name_length, extra_length = _LOCAL_HEADER.unpack(header)
    return entry.header_offset + _LOCAL_HEADER.size + int(name_length) + int(extra_length)


def _check_collisions(path: Path, names: Iterable[str]) -> None:
    """Two files that would be written to one place, or a file where a folder is to be."""
    places = Counter(PurePosixPath(n.casefold() if _folds_case else n) for n in names)
    for place, count in places.items():
        if count > 1:
            raise FMULoadError(f"{path.name} has two files of one name: {str(place)!r}")
        for parent in place.parents:
            if parent in places:
                raise FMULoadError(f"{path.name} has a file that is also a folder: {str(parent)!r}")
