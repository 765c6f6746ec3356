"""Finder of Wine on this machine, and translation of paths."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final
from urllib.parse import quote

import fmpy

from fmugym.errors import FMULoadError
from fmugym.wine.windows_worker import is_buildable, known_program

__all__ = [
    "can_run_windows",
    "find_wine",
    "obstacle_to_wine",
    "windows_path",
    "windows_uri",
    "wine_version",
]

_NAMES: Final = ("wine64", "wine")
_PLACES: Final = ("/usr/lib/wine/wine64", "/opt/wine-stable/bin/wine64", "/opt/wine-devel/bin/wine")
"""Folders of packages with the loader, outside of the search path; the first is Debian's."""

_HOW_TO_GET_WINE: Final = (
    "install Wine (on Debian and Ubuntu: apt install wine64; on Fedora: dnf install wine-core), or "
    "name its loader in the environment variable FMUGYM_WINE"
)
_HOW_TO_GET_ZIG: Final = (
    "install the compiler that builds the worker program once: ziglang, of the extra 'windows'; in "
    "a clone of fmugym: pip install '.[windows]'"
)


def can_run_windows() -> bool:
    """Whether this is a system on which Wine could run libraries for Windows on x86_64."""
    return sys.platform == "linux" and bool(fmpy.architecture == "x86_64")


def find_wine() -> Path | None:
    """Find the loader of 64-bit Wine: ``FMUGYM_WINE``, or in the search path, or of a package.

    Returns:
        Its path; None if there is none.
    """
    given = os.environ.get("FMUGYM_WINE", "")
    found = [shutil.which(name) for name in ((given,) if given else _NAMES)]
    places = [] if given else [place for place in _PLACES if os.access(place, os.X_OK)]
    return next((Path(path).absolute() for path in (*found, *places) if path), None)


def obstacle_to_wine() -> str:
    """Name the missing condition for Windows libraries; "" if there is none."""
    missing = [] if find_wine() is not None else [_HOW_TO_GET_WINE]
    if known_program() is None and not is_buildable():
        missing.append(_HOW_TO_GET_ZIG)
    return "; and ".join(missing)


@functools.lru_cache(maxsize=8)
def wine_version(loader: Path) -> str:
    """Ask Wine for its version, for example ``wine-8.0 (Debian 8.0~repack-4)``.

    Raises:
        FMULoadError: If it does not run.
    """
    try:
        done = subprocess.run(
            [str(loader), "--version"], capture_output=True, text=True, timeout=60, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise FMULoadError(f"Wine does not run: {error}") from None
    return done.stdout.strip()


def windows_path(path: str | os.PathLike[str]) -> str:
    """Name a file of this system for a program in Wine, whose drive Z: is the root folder."""
    return "Z:" + os.path.abspath(path).replace("/", "\\")


def windows_uri(path: str | os.PathLike[str]) -> str:
    """Name a file of this system by a URI for a program in Wine."""
    return "file:///Z:" + quote(os.path.abspath(path))
