"""Shared libraries, looked at before they are loaded.

A library of another processor, a cut one, or one whose own libraries are missing makes the system's
loader fail with a misleading text, or ends the process. The formats: ELF (System V ABI, "Object
Files" and "Dynamic Linking"; ld.so(8)), PE (Microsoft's "PE Format") and Mach-O (Apple's
``mach-o/loader.h`` and ``fat.h``).
"""

from __future__ import annotations

import ctypes
import os
import struct
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import fmpy

from fmugym.errors import FMULoadError

__all__ = ["check_library", "load_globally", "missing_libraries"]

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

_ELF_HEADER: Final = struct.Struct("<16sHHIQQQIHHHHHH")
_ELF_SEGMENT: Final = struct.Struct("<IIQQQQQQ")
_ELF_SHARED = 3
_PT_LOAD, _PT_DYNAMIC = 1, 2
_DT_NEEDED, _DT_STRTAB, _DT_STRSZ, _DT_RPATH, _DT_RUNPATH = 1, 5, 10, 15, 29

_PE_HEADER: Final = struct.Struct("<4sHHIIIHH")
_PE_SECTION: Final = struct.Struct("<8sIIIIIIHHI")
_PE_DLL = 0x2000

_MACH_O_HEADER: Final = struct.Struct("<IIIIIII")
_MACH_O_KINDS: Final = {6, 8}
"""``MH_DYLIB`` and ``MH_BUNDLE``."""
_LC_SEGMENT_64 = 0x19
_MOST_SLICES: Final = 64
_MOST_TABLE_BYTES: Final = 16 * 2**20
"""No table of a library that an exporter made is longer."""


def check_library(
    file: BinaryIO, size: int, name: str, architecture: str = fmpy.architecture
) -> None:
    """Check the headers of a shared library.

    Args:
        file: The library, seekable, at its beginning.
        size: Its length in bytes.
        name: Its file name; the suffix tells which system it must be for.
        architecture: The processor it must be for, in FMPy's naming.

    Raises:
        FMULoadError: If it is none, cut short, or for another system or processor.
    """
    suffix = Path(name).suffix
    magic = file.read(4)
    found = next((s for m, s in _MAGIC.items() if magic.startswith(m)), None)
    if found != suffix:
        what = "not a shared library" if found is None else f"a library of {_SYSTEMS[found]}"
        raise FMULoadError(f"{name} is {what}, expected one of {_SYSTEMS[suffix]}")
    try:
        _CHECKS[suffix](_Source(file, size, name), architecture)
    except struct.error:
        raise _cut_short(name, size) from None


def _cut_short(name: str, size: int) -> FMULoadError:
    return FMULoadError(f"{name} is cut short ({size} bytes); copy or export the FMU again")


@dataclass(frozen=True)
class _Source:
    """The bytes of a library."""

    file: BinaryIO
    size: int
    name: str

    def read(self, offset: int, count: int) -> bytes:
        """Read from anywhere; fewer bytes at the end."""
        self.file.seek(min(offset, self.size))
        return self.file.read(min(count, _MOST_TABLE_BYTES))

    def unpack(self, layout: struct.Struct, offset: int) -> tuple[int, ...]:
        """Read a structure."""
        return layout.unpack(self.read(offset, layout.size))

    def require(self, end: int) -> None:
        """Refuse a library that does not reach so far."""
        if end > self.size:
            raise _cut_short(self.name, self.size)

    def require_shared(self, shared: bool) -> None:
        """Refuse a program or an object file."""
        if not shared:
            raise FMULoadError(f"{self.name} is not a shared library; export the FMU again")

    def require_machine(self, built_for: Iterable[str], architecture: str) -> None:
        """Refuse a library of other processors."""
        if architecture not in built_for:
            raise FMULoadError(
                f"{self.name} was built for {' and '.join(built_for) or 'no processor'}, this "
                f"process runs on {architecture}; export the FMU for that"
            )


# ELF


@dataclass(frozen=True)
class _Segment:
    kind: int
    offset: int
    address: int
    size: int


def _check_elf(source: _Source, architecture: str) -> None:
    identity = source.read(0, 20)
    (machine,) = struct.unpack_from("<H", identity, 18)
    name = _ELF_MACHINES.get(machine, f"ELF machine {machine}")
    source.require_machine([name], architecture)
    if identity[4:6] != b"\x02\x01":  # 32 bits, or the other byte order: no more is known of it
        source.require_shared(architecture == "x86")
        return
    header = source.unpack(_ELF_HEADER, 0)
    source.require_shared(header[1] == _ELF_SHARED)
    source.require(header[6] + header[11] * header[12])
    for segment in _elf_segments(source):
        source.require(segment.offset + segment.size)


def _elf_segments(source: _Source) -> list[_Segment]:
    header = source.unpack(_ELF_HEADER, 0)
    offset, size, count = header[5], header[9], header[10]
    rows = (source.unpack(_ELF_SEGMENT, offset + k * size) for k in range(count))
    return [
        _Segment(kind, start, address, length) for kind, _, start, address, _, length, *_ in rows
    ]


def _elf_dynamic(source: _Source) -> list[tuple[int, int]]:
    """The tags and values of the dynamic section."""
    for segment in _elf_segments(source):
        if segment.kind == _PT_DYNAMIC:
            table = source.read(segment.offset, segment.size)
            return list(struct.iter_unpack("<QQ", table[: len(table) // 16 * 16]))
    return []


def _elf_strings(source: _Source, dynamic: list[tuple[int, int]]) -> bytes:
    values = dict(dynamic)
    address, size = values.get(_DT_STRTAB, 0), values.get(_DT_STRSZ, 0)
    for segment in _elf_segments(source):
        if segment.kind == _PT_LOAD and 0 <= address - segment.address < segment.size:
            return source.read(segment.offset + address - segment.address, size)
    return b""


def _elf_dependencies(library: Path) -> tuple[list[str], list[Path]]:
    """The libraries that a library needs, and the folders where it wants them looked for."""
    size = library.stat().st_size
    with library.open("rb") as file:
        source = _Source(file, size, library.name)
        try:
            dynamic = _elf_dynamic(source)
            strings = _elf_strings(source, dynamic)
        except struct.error:  # one that comes with the FMU's own library, which has been checked
            raise _cut_short(library.name, size) from None

    def texts(*tags: int) -> Iterator[str]:
        for tag, value in dynamic:
            if tag in tags:
                yield os.fsdecode(strings[value:].split(b"\0", 1)[0])

    folders = [f for text in texts(_DT_RPATH, _DT_RUNPATH) for f in text.split(":") if f]
    origin = str(library.parent)
    expanded = [f.replace("$ORIGIN", origin).replace("${ORIGIN}", origin) for f in folders]
    return list(texts(_DT_NEEDED)), [Path(folder) for folder in expanded]


# PE


def _check_pe(source: _Source, architecture: str) -> None:
    (start,) = source.unpack(struct.Struct("<I"), 0x3C)
    signature, machine, count, _, _, _, optional_size, flags = _PE_HEADER.unpack(
        source.read(start, _PE_HEADER.size)
    )
    source.require_shared(signature == b"PE\0\0" and bool(flags & _PE_DLL))
    name = _PE_MACHINES.get(machine, f"PE machine {machine:#x}")
    source.require_machine([name], architecture)
    sections = start + _PE_HEADER.size + optional_size
    for index in range(count):
        row = source.unpack(_PE_SECTION, sections + index * _PE_SECTION.size)
        source.require(row[3] + row[4])  # size and place of the raw data


# Mach-O


def _check_mach_o(source: _Source, architecture: str) -> None:
    slices = dict(_mach_o_slices(source))
    source.require_machine(list(slices), architecture)
    start = slices[architecture]
    _, _, _, kind, count, _, _ = source.unpack(_MACH_O_HEADER, start)
    source.require_shared(kind in _MACH_O_KINDS)
    place = start + _MACH_O_HEADER.size + 4  # the 64-bit header has a reserved word
    for _ in range(count):
        command, length = source.unpack(struct.Struct("<II"), place)
        if command == _LC_SEGMENT_64:
            offset, size = source.unpack(struct.Struct("<QQ"), place + 40)
            source.require(start + offset + size)
        if length < 8:
            raise _cut_short(source.name, source.size)
        place += length


def _mach_o_slices(source: _Source) -> Iterator[tuple[str, int]]:
    """Processor and place of each part of a universal library; a thin one is its only part."""
    magic, count = struct.unpack(">II", source.read(0, 8))
    if magic not in (0xCAFEBABE, 0xCAFEBABF):
        machine = source.unpack(_MACH_O_HEADER, 0)[1]
        yield _mach_o_name(machine), 0
        return
    row = struct.Struct(">IIQQII") if magic == 0xCAFEBABF else struct.Struct(">IIIII")
    for index in range(min(count, _MOST_SLICES)):
        machine, _, offset, size, *_ = source.unpack(row, 8 + index * row.size)
        source.require(offset + size)
        yield _mach_o_name(machine), offset


def _mach_o_name(machine: int) -> str:
    return _MACH_O_MACHINES.get(machine, f"Mach-O processor {machine:#x}")


_CHECKS: Final[dict[str, Callable[[_Source, str], None]]] = {
    ".so": _check_elf,
    ".dll": _check_pe,
    ".dylib": _check_mach_o,
}


# What a library needs


def missing_libraries(library: Path) -> list[str]:
    """Find the shared libraries that a library needs and the system's loader would not find.

    They are looked for as the loader does: those loaded already, the library's own search path
    (``$ORIGIN`` is its folder), and, by asking the loader itself, ``LD_LIBRARY_PATH``, the cache
    of ldconfig and the system's folders. The libraries of libraries that the FMU brings along are
    looked for too. Nothing of the FMU is loaded.

    Args:
        library: The library, extracted.

    Returns:
        Their names; empty on systems other than Linux, where the loader's own message must do.

    Raises:
        FMULoadError: If a library that the FMU brings along is cut short.
    """
    if sys.platform != "linux":
        return []
    missing: list[str] = []
    seen: set[str] = set()
    todo: list[tuple[Path, list[Path]]] = [(library, [])]
    while todo:
        path, inherited = todo.pop()
        names, own = _elf_dependencies(path)
        folders = own + inherited
        for name in names:
            if name in seen:
                continue
            seen.add(name)
            beside = next((f / name for f in folders if (f / name).is_file()), None)
            if beside is not None:
                todo.append((beside, folders))
            else:
                missing += _not_found(name)
    return missing


def _not_found(name: str) -> list[str]:
    """What the loader misses when asked for a library: that one, or one that it needs."""
    try:
        ctypes.CDLL(name)
    except OSError as error:
        missing, _, reason = str(error).partition(": ")
        return [missing if reason.startswith("cannot open shared object file") else name]
    return []


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
        raise FMULoadError(f"{path!r} of preload cannot be loaded: {error}") from None
