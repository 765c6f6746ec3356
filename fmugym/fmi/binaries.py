"""Binaries of an FMU: operating system and processor of a shared library, and headers of ELF.

They are read before a library is loaded. The loaders of most systems answer a library of another
processor with a misleading text ("No such file", "Windows error 193"), and Linux ends the process
when a library is cut short.

ELF is the format of Linux, here of 64 bits, little-endian. Sources: System V ABI, "Object Files"
and "Dynamic Linking"; the Linux Standard Base, "Symbol Versioning"; ld.so(8). The project reads ELF
by itself because the usual libraries for it raise exceptions of many kinds, and read without
bounds, when a file is damaged. Other formats: PE, Microsoft's "PE Format"; Mach-O, Apple's
``mach-o/loader.h`` and ``fat.h``. How PE and Mach-O go on after the header is left to the loaders
of Windows and macOS, which check it themselves.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import fmpy

from fmugym.errors import FMULoadError

__all__ = ["BinaryFile", "ElfLibrary", "check_library", "opened"]

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
        """The soname: the name by which other libraries need this one."""
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


_MAGIC: Final = {
    b"\x7fELF": ".so",
    b"MZ": ".dll",
    b"\xcf\xfa\xed\xfe": ".dylib",
    b"\xce\xfa\xed\xfe": ".dylib",
    b"\xca\xfe\xba\xbe": ".dylib",
    b"\xca\xfe\xba\xbf": ".dylib",
}
_SYSTEMS: Final = {".so": "Linux (ELF)", ".dll": "Windows (PE)", ".dylib": "macOS (Mach-O)"}

_ELF_MACHINES: Final = {3: "x86", 40: "arm", 62: "x86_64", 183: "aarch64", 243: "riscv64"}
_PE_MACHINES: Final = {0x14C: "x86", 0x8664: "x86_64", 0xAA64: "aarch64"}
_MACH_O_MACHINES: Final = {7: "x86", 0x01000007: "x86_64", 0x0100000C: "aarch64"}

_ELF_64_LITTLE: Final = b"\x02\x01"
_PE_HEADER: Final = struct.Struct("<4sHHIIIHH")
_PE_DLL: Final = 0x2000
_MACH_O_HEADER: Final = struct.Struct("<IIIIIII")
_MACH_O_KINDS: Final = {6, 8}
"""``MH_DYLIB`` and ``MH_BUNDLE``."""
_UNIVERSAL: Final = {
    0xCAFEBABE: struct.Struct(">IIIII"),
    0xCAFEBABF: struct.Struct(">IIQQII"),
}
_MOST_SLICES: Final = 64


def check_library(file: BinaryIO, size: int, name: str) -> None:
    """Check the headers of a shared library, which must be for the processor of this process.

    Args:
        file: The library, seekable, at its beginning.
        size: Its length in bytes.
        name: Its file name; the suffix tells which system it must be for.

    Raises:
        FMULoadError: If it is not a shared library, cut short, or for another system or processor.
    """
    suffix = Path(name).suffix.lower()
    magic = file.read(4)
    found = next((s for m, s in _MAGIC.items() if magic.startswith(m)), None)
    if found != suffix:
        what = "not a shared library" if found is None else f"a library of {_SYSTEMS[found]}"
        raise FMULoadError(f"{name} is {what}, expected one of {_SYSTEMS[suffix]}")
    _CHECKS[suffix](BinaryFile(file, size, name), fmpy.architecture)


def _require_shared(source: BinaryFile, shared: bool) -> None:
    if not shared:
        raise FMULoadError(f"{source.name} is not a shared library; export the FMU again")


def _require_machine(source: BinaryFile, built_for: list[str], architecture: str) -> None:
    if architecture not in built_for:
        raise FMULoadError(
            f"{source.name} was built for {' and '.join(built_for) or 'no processor'}, this "
            f"process runs on {architecture}; export the FMU for {architecture}"
        )


def _check_elf(source: BinaryFile, architecture: str) -> None:
    kind, machine = source.unpack(struct.Struct("<4x2s12xH"), 0)
    name = _ELF_MACHINES.get(machine, f"ELF machine {machine}")
    _require_machine(source, [name], architecture)
    if kind != _ELF_64_LITTLE:  # of other ELF files no more is known here
        _require_shared(source, architecture == "x86")
        return
    library = ElfLibrary(source)
    _require_shared(source, library.is_shared)
    library.check_complete()


def _check_pe(source: BinaryFile, architecture: str) -> None:
    (start,) = source.unpack(struct.Struct("<I"), 0x3C)
    signature, machine, *_, flags = source.unpack(_PE_HEADER, start)
    _require_shared(source, signature == b"PE\0\0" and bool(flags & _PE_DLL))
    name = _PE_MACHINES.get(machine, f"PE machine {machine:#x}")
    _require_machine(source, [name], architecture)


def _check_mach_o(source: BinaryFile, architecture: str) -> None:
    slices = dict(_mach_o_slices(source))
    _require_machine(source, list(slices), architecture)
    kind = source.unpack(_MACH_O_HEADER, slices[architecture])[3]
    _require_shared(source, kind in _MACH_O_KINDS)


def _mach_o_slices(source: BinaryFile) -> Iterator[tuple[str, int]]:
    """Processor and place of each part of a universal library; a thin one is its only part."""
    magic, count = source.unpack(struct.Struct(">II"), 0)
    row = _UNIVERSAL.get(magic)
    if row is None:
        yield _mach_o_name(source.unpack(_MACH_O_HEADER, 0)[1]), 0
        return
    for index in range(min(count, _MOST_SLICES)):
        machine, _, offset, size, *_ = source.unpack(row, 8 + index * row.size)
        source.require(offset + size)
        yield _mach_o_name(machine), offset


def _mach_o_name(machine: int) -> str:
    return _MACH_O_MACHINES.get(machine, f"Mach-O processor {machine:#x}")


_CHECKS: Final[dict[str, Callable[[BinaryFile, str], None]]] = {
    ".so": _check_elf,
    ".dll": _check_pe,
    ".dylib": _check_mach_o,
}
