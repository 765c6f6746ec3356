"""Headers of ELF libraries: the format of Linux, 64 bits, little-endian.

Sources: System V ABI, "Object Files" and "Dynamic Linking"; the Linux Standard Base, "Symbol
Versioning"; ld.so(8). The project reads ELF by itself because the usual libraries for it raise
exceptions of many kinds, and read without bounds, when a file is damaged.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from fmugym.errors import FMULoadError

__all__ = ["BinaryFile", "ElfLibrary", "opened"]

_MOST_BYTES: Final = 16 * 2**20
"""No table of a library that an exporter made is longer."""

_HEADER: Final = struct.Struct("<16sHHIQQQIHHHHHH")
_SEGMENT: Final = struct.Struct("<IIQQQQQQ")
_SECTION: Final = struct.Struct("<IIQQQQIIQQ")
_SYMBOL: Final = struct.Struct("<IBBHQQ")
_ENTRY: Final = struct.Struct("<QQ")
_INDEX: Final = struct.Struct("<H")
_NEED: Final = struct.Struct("<HHIII")
_NEEDED_VERSION: Final = struct.Struct("<IHHII")
_SHARED: Final = 3
_LOAD, _DYNAMIC = 1, 2
_WRITABLE: Final = 2
_SYMBOL_TABLE: Final = 11
_VERSION_TABLE: Final = 0x6FFFFFFF
_NEEDED_TABLE: Final = 0x6FFFFFFE
_NEEDED, _STRINGS, _STRINGS_SIZE, _SONAME, _RPATH, _RUNPATH = 1, 5, 10, 14, 15, 29
_MOST_VERSIONS: Final = 10_000
_MOST_LIBRARIES: Final = 1_000
_MOST_FOLDERS: Final = 100
"""No library has more of these, but a damaged one may seem to."""


def _cut_short(name: str, size: int) -> FMULoadError:
    """Make the error for a file that ends too early."""
    return FMULoadError(f"{name} is cut short ({size} bytes); copy or export the FMU again")


@dataclass(frozen=True)
class BinaryFile:
    """A file with its size in bytes and its name for errors."""

    file: BinaryIO
    size: int
    name: str

    def read(self, offset: int, count: int) -> bytes:
        """Read from anywhere; fewer bytes at the end of the file."""
        self.file.seek(min(offset, self.size))
        return self.file.read(min(count, _MOST_BYTES))

    def unpack(self, layout: struct.Struct, offset: int) -> tuple[Any, ...]:
        """Read a structure.

        Raises:
            FMULoadError: If the file ends before.
        """
        content = self.read(offset, layout.size)
        if len(content) < layout.size:
            raise _cut_short(self.name, self.size)
        return layout.unpack(content)

    def rows(self, layout: struct.Struct, offset: int, count: int) -> Iterator[tuple[Any, ...]]:
        """Read the whole structures that so many bytes hold; fewer at the end of the file."""
        content = self.read(offset, count)
        return layout.iter_unpack(content[: len(content) // layout.size * layout.size])

    def require(self, end: int) -> None:
        """Refuse a file that is shorter than ``end`` bytes."""
        if end > self.size:
            raise _cut_short(self.name, self.size)


class Segment(NamedTuple):
    """A row of the program header."""

    kind: int
    is_writable: bool
    offset: int
    address: int
    size: int
    size_in_memory: int


class ElfLibrary:
    """The tables of a library.

    Args:
        source: The file.

    Raises:
        FMULoadError: In every method, if the file is cut short.
    """

    def __init__(self, source: BinaryFile) -> None:
        self._source = source
        self._header = source.unpack(_HEADER, 0)

    @property
    def is_shared(self) -> bool:
        """Whether it is a shared library, not a program or an object file."""
        return bool(self._header[1] == _SHARED)

    def check_complete(self) -> None:
        """Refuse a file that lacks a part. The loader would end the process with SIGBUS."""
        self._source.require(self._header[6] + self._header[11] * self._header[12])
        for segment in self._segments:
            self._source.require(segment.offset + segment.size)

    @cached_property
    def _segments(self) -> list[Segment]:
        offset, size, count = self._header[5], self._header[9], self._header[10]
        rows = (self._source.unpack(_SEGMENT, offset + k * size) for k in range(count))
        return [
            Segment(kind, bool(flags & _WRITABLE), start, address, length, length_in_memory)
            for kind, flags, start, address, _, length, length_in_memory, _ in rows
        ]

    @property
    def writable(self) -> list[tuple[int, int]]:
        """Distance from the beginning of the loaded file, and size, of its writable data."""
        loaded = [segment for segment in self._segments if segment.kind == _LOAD]
        begin = next((s.address for s in loaded if s.offset == 0), 0)
        return [(s.address - begin, s.size_in_memory) for s in loaded if s.is_writable]

    @cached_property
    def _dynamic(self) -> list[tuple[int, int]]:
        """Tags and values of the dynamic section."""
        for segment in self._segments:
            if segment.kind == _DYNAMIC:
                return list(self._source.rows(_ENTRY, segment.offset, segment.size))
        return []

    @cached_property
    def _strings(self) -> bytes:
        values = dict(self._dynamic)
        address, size = values.get(_STRINGS, 0), values.get(_STRINGS_SIZE, 0)
        for segment in self._segments:
            if segment.kind == _LOAD and 0 <= address - segment.address < segment.size:
                return self._source.read(segment.offset + address - segment.address, size)
        return b""

    def _string(self, offset: int) -> str:
        return os.fsdecode(self._strings[offset : offset + 4096].split(b"\0", 1)[0])

    def _texts(self, *tags: int) -> list[str]:
        return [self._string(value) for tag, value in self._dynamic if tag in tags]

    @property
    def needed(self) -> list[str]:
        """The names of the libraries that it needs."""
        return self._texts(_NEEDED)[:_MOST_LIBRARIES]

    @property
    def soname(self) -> str | None:
        """The name by which other libraries know it."""
        return next(iter(self._texts(_SONAME)), None)

    def search_path(self, folder: Path) -> list[Path]:
        """The folders in which the loader is to look for its libraries; ``folder`` is its own."""
        origin = str(folder)
        entries = [f for text in self._texts(_RPATH, _RUNPATH) for f in text.split(":") if f]
        expanded = [f.replace("$ORIGIN", origin).replace("${ORIGIN}", origin) for f in entries]
        return [Path(folder) for folder in expanded[:_MOST_FOLDERS]]

    # Symbol versions

    def needed_symbols(self, library: str) -> dict[str, str]:
        """The symbols that it takes from a library, each with the version it asks for.

        Args:
            library: One of ``needed``.

        Returns:
            Versions by symbol. Symbols without a version do not say from which library they come,
            and are left out.
        """
        versions = {i: name for file, i, name in self._needed_versions if file == library}
        found = {}
        for (name, _), index in zip(self._symbols(), self._versions_of_symbols(), strict=False):
            if index in versions:
                found[name] = versions[index]
        return found

    def unversioned_symbols(self) -> set[str]:
        """The symbols that it takes from any library, without asking for a version."""
        undefined = [name for name, is_defined in self._symbols() if name and not is_defined]
        files = {file for file, _, _ in self._needed_versions}
        versioned = {symbol for file in files for symbol in self.needed_symbols(file)}
        return set(undefined) - versioned

    def _sections(self, kind: int) -> Iterator[tuple[int, int]]:
        """Place and size of the sections of a kind."""
        offset, size, count = self._header[6], self._header[11], self._header[12]
        for row in range(count):
            _, type_, _, _, start, length, *_ = self._source.unpack(_SECTION, offset + row * size)
            if type_ == kind:
                yield start, length

    def _symbols(self) -> Iterator[tuple[str, bool]]:
        """The name of each symbol, and whether the library defines it itself."""
        for start, length in self._sections(_SYMBOL_TABLE):
            for row in self._source.rows(_SYMBOL, start, length):
                yield self._string(row[0]), row[3] != 0

    def _versions_of_symbols(self) -> Iterator[int]:
        for start, length in self._sections(_VERSION_TABLE):
            for (index,) in self._source.rows(_INDEX, start, length):
                yield index & 0x7FFF

    @cached_property
    def _needed_versions(self) -> list[tuple[str, int, str]]:
        """Library, number and name of each version that symbols refer to."""
        return list(islice(self._versions(), _MOST_VERSIONS))

    def _versions(self) -> Iterator[tuple[str, int, str]]:
        for place, _ in self._sections(_NEEDED_TABLE):
            next_need = 1
            while next_need:
                _, count, file, first, next_need = self._source.unpack(_NEED, place)
                yield from self._versions_of(self._string(file), place + first, max(count, 1))
                place += next_need

    def _versions_of(self, file: str, place: int, count: int) -> Iterator[tuple[str, int, str]]:
        for _ in range(count):
            _, _, index, name, next_version = self._source.unpack(_NEEDED_VERSION, place)
            yield file, index & 0x7FFF, self._string(name)
            place += next_version


@contextmanager
def opened(path: Path) -> Iterator[ElfLibrary]:
    """Open a library as a context.

    Raises:
        FMULoadError: If it is cut short.
    """
    with path.open("rb") as file:
        yield ElfLibrary(BinaryFile(file, path.stat().st_size, path.name))
