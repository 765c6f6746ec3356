"""Operating system and processor of a shared library, read before it is loaded.

The loaders of most systems answer a library of another processor with a misleading text ("No such
file", "Windows error 193"), and Linux ends the process when a library is cut short. The formats:
ELF, see ``fmugym.archive.elf``; PE, Microsoft's "PE Format"; Mach-O, Apple's ``mach-o/loader.h``
and ``fat.h``. How PE and Mach-O go on after the header is left to the loaders of Windows and macOS,
which check it themselves.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Final

import fmpy

from fmugym.archive.elf import BinaryFile, ElfLibrary
from fmugym.errors import FMULoadError

__all__ = ["check_library"]

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
