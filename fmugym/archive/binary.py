"""Reading structures from a binary file that may end too early."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, BinaryIO, Final

from fmugym.errors import FMULoadError

__all__ = ["BinaryFile", "cut_short"]

_MOST_BYTES: Final = 16 * 2**20
"""No table of a library that an exporter made is longer."""


def cut_short(name: str, size: int) -> FMULoadError:
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
            raise cut_short(self.name, self.size)
        return layout.unpack(content)

    def require(self, end: int) -> None:
        """Refuse a file that is shorter than ``end`` bytes."""
        if end > self.size:
            raise cut_short(self.name, self.size)
