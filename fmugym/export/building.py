"""Compiling exported agents."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

import fmpy

from fmugym.errors import ConfigError
from fmugym.extras import c_compiler

__all__ = ["PLATFORMS", "Platform", "compiled"]


class Platform(NamedTuple):
    """A platform to build for.

    Attributes:
        target: zig's target triple.
        extension: The file name extension of shared libraries.
        folder: Its folder in FMI 2.0; None if that version does not have one.
    """

    target: str
    extension: str
    folder: str | None


PLATFORMS: Final[Mapping[str, Platform]] = {
    "x86_64-linux": Platform("x86_64-linux-gnu.2.17", ".so", "linux64"),
    "aarch64-linux": Platform("aarch64-linux-gnu.2.17", ".so", None),
    "x86_64-windows": Platform("x86_64-windows-gnu", ".dll", "win64"),
    "x86_64-darwin": Platform("x86_64-macos.10.13", ".dylib", "darwin64"),
    "aarch64-darwin": Platform("aarch64-macos.11.0", ".dylib", None),
}
"""The platforms by their folders in FMI 3.0."""

_OPTIONS: Final = (
    *("-std=c99", "-O2", "-g0", "-ffp-contract=off", "-Wno-unused-parameter", "-shared", "-fPIC"),
    *("-fvisibility=hidden",),
)
_LONGEST_MESSAGE: Final = 800


def compiled(folder: Path, files: list[str], name: str, where: str) -> bytes:
    """Compile C sources to a shared library.

    Args:
        folder: Folder of the sources.
        files: Their names.
        name: The name of the library, without its extension.
        where: One of ``PLATFORMS``.

    Raises:
        ConfigError: If there is no compiler for this platform, or it fails.
    """
    known = PLATFORMS[where]
    with tempfile.TemporaryDirectory(prefix="fmugym-export-") as scratch:
        library = Path(scratch) / f"{name}{known.extension}"
        command = [*_compiler(where), *_OPTIONS, f"-I{folder}", *files, "-o", str(library)]
        if known.extension == ".dylib":
            command.append(f"-Wl,-install_name,@rpath/{library.name}")
        done = subprocess.run(
            [*command, "-lm"], cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise ConfigError(
                f"the library for {where} cannot be built: {done.stderr[-_LONGEST_MESSAGE:]}"
            )
        return library.read_bytes()


def _compiler(where: str) -> list[str]:
    """The compiler of this system for this platform; ziglang for all others, and on Windows."""
    is_own = sys.platform != "win32" and where == fmpy.platform_tuple
    return c_compiler(f"the library for {where}", PLATFORMS[where].target, is_own=is_own)
