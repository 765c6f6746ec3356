"""Writable data of an FMU's libraries in the memory of a worker.

All instances of a library share these data. Data of runtime libraries that FMUs bring along do not
count, nor does what is on the heap. It needs the maps of memory of Linux.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import Final, NamedTuple

from fmugym.fmi.binaries import opened
from fmugym.fmi.fmu import FMU

__all__ = ["library_data"]

logger = logging.getLogger(__name__)

_RUNTIMES: Final = (
    *("libc.", "libc++", "libgcc", "libgfortran", "libgomp", "libm.", "libpython", "libquadmath"),
    *("libstdc++",),
)
"""How the names of libraries begin that FMUs bring along and that threads may share."""


class _Place(NamedTuple):
    """Writable data of a library in the memory of a process."""

    library: Path
    address: int
    size: int


def library_data(fmu: FMU, process: int) -> dict[_Place, int]:
    """The checksums of the writable data of the libraries that an FMU has brought along.

    Args:
        fmu: The FMU, in the folder that the process has loaded it from.
        process: A child of this process. An operating system may be so strict that its memory
            cannot be read; a warning tells that.

    Returns:
        A checksum for each place; none where libraries cannot be found in memory.
    """
    places = list(_places(fmu, process))
    if not places:
        return {}
    try:
        with open(f"/proc/{process}/mem", "rb", buffering=0) as memory:
            return {place: _checksum(memory, place) for place in places}
    except OSError as error:
        logger.warning("data that instances share cannot be watched: %s", error)
        return {}


def _places(fmu: FMU, process: int) -> Iterator[_Place]:
    """The writable data of the libraries that the FMU has brought along and loaded."""
    folder = fmu.extract().resolve()
    for library, base in _loaded_libraries(process).items():
        if library.is_relative_to(folder) and not library.name.startswith(_RUNTIMES):
            with opened(library) as elf:
                for address, size in elf.writable:
                    yield _Place(library, base + address, size)


def _loaded_libraries(process: int) -> dict[Path, int]:
    """The address at which each file is mapped into a process; none where that is not told."""
    bases: dict[Path, int] = {}
    maps = Path(f"/proc/{process}/maps")
    lines = maps.read_text(errors="surrogateescape").splitlines() if maps.exists() else []
    for addresses, _, offset, _, _, *path in (line.split(maxsplit=5) for line in lines):
        if path and path[0].startswith("/") and int(offset, 16) == 0:
            bases.setdefault(Path(path[0]), int(addresses.partition("-")[0], 16))
    return bases


def _checksum(memory: FileIO, place: _Place) -> int:
    memory.seek(place.address)
    return zlib.crc32(memory.read(place.size) or b"")
