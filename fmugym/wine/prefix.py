"""Wine's prefix: a folder with its registry and system libraries.

Each version of Wine gets one of this package's own, which is made once. Nothing in it opens a
window, asks the network, or runs in the background.
"""

from __future__ import annotations

import filecmp
import logging
import os
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

from fmugym.errors import FMULoadError, printable
from fmugym.wine.installation import find_wine, obstacle_to_wine, wine_version
from fmugym.wine.windows_worker import alone, wine_folder, worker_program

__all__ = ["Wine"]

logger = logging.getLogger(__name__)

_READY: Final = "made-by-fmugym"
"""A file in a prefix that is complete."""

_TEMPORARY: Final = "temporary"
"""The folder in a prefix for sockets, which Debian's Wine leaves behind."""

_DISPLAYS: Final = ("DISPLAY", "WAYLAND_DISPLAY")
_ALWAYS_OFF: Final = "winemenubuilder.exe,winedbg.exe,mscoree,mshtml=d"
"""They would write menus, open a debugger, and download runtimes of .NET and HTML."""
_OFF_IN_WORKERS: Final = f"services.exe,explorer.exe,{_ALWAYS_OFF}"
"""Services in the background need a second to start, and outlive a worker."""

_LIBRARIES: Final = (
    "usr/lib*/wine/x86_64-windows/*.*",
    "usr/lib/*/wine/x86_64-windows/*.*",
    "opt/wine-*/lib*/wine/x86_64-windows/*.*",
)
"""Folders of packages with Wine's own libraries."""

_LONGEST_MAKING: Final = 600.0
"""Seconds; making a prefix takes some 15 s."""


class Wine(NamedTuple):
    """Paths and environment of a worker in Wine.

    Attributes:
        loader: Wine's own program.
        program: The worker program for Windows.
        prefix: The folder with Wine's registry and system libraries.
    """

    loader: Path
    program: Path
    prefix: Path

    @classmethod
    def ready(cls) -> Wine:
        """Find Wine; build the program and make the prefix, each if there is none yet.

        Raises:
            FMULoadError: If something is missing here, or cannot be made.
        """
        loader, obstacle = find_wine(), obstacle_to_wine()
        if loader is None or obstacle:
            raise FMULoadError(f"Windows libraries run here in Wine: {obstacle}")
        return cls(loader, worker_program(), _prefix_for(loader))

    @property
    def command(self) -> list[str]:
        """The program and its arguments."""
        return [str(self.loader), str(self.program)]

    def environment(self, outside: Mapping[str, str]) -> dict[str, str]:
        """Environment variables of a worker, from the variables of a process outside of Wine."""
        return _environment(self.prefix, outside, _OFF_IN_WORKERS)


def _environment(prefix: Path, outside: Mapping[str, str], off: str) -> dict[str, str]:
    """Leave out displays, and libraries that Wine must not load; the user's choices count."""
    own = {name: value for name, value in outside.items() if name not in _DISPLAYS}
    overrides = ";".join(filter(None, (off, own.get("WINEDLLOVERRIDES", ""))))
    own.setdefault("WINEDEBUG", "-all")
    places = {"WINEPREFIX": str(prefix), "TMPDIR": str(prefix / _TEMPORARY)}
    return own | places | {"WINEDLLOVERRIDES": overrides}


def _prefix_for(loader: Path) -> Path:
    """Return the prefix for a version of Wine, which is made if there is none yet.

    Raises:
        FMULoadError: If it cannot be made.
    """
    slug = "".join(c if c.isalnum() else "-" for c in wine_version(loader))
    prefix = wine_folder() / f"prefix-{slug}"
    if (prefix / _READY).exists():
        return prefix
    with alone("prefix"):
        if not (prefix / _READY).exists():
            shutil.rmtree(prefix, ignore_errors=True)  # of a process that was ended half-way
            _make(loader, prefix)
    return prefix


def _make(loader: Path, prefix: Path) -> None:
    logger.info("making Wine's folder %s, once; it takes some 15 s", prefix)
    environment = _environment(prefix, os.environ, _ALWAYS_OFF)
    log = prefix.with_suffix(".log")
    try:
        (prefix / _TEMPORARY).mkdir(parents=True)
        with log.open("wb") as output:  # no pipe: services of Wine keep it open for a while
            subprocess.run(
                [str(loader), "wineboot", "--init"],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                timeout=_LONGEST_MAKING,
                check=True,
            )
        _link_libraries(prefix)
        (prefix / ".update-timestamp").write_text("disable\n")  # or else Wine writes to the links
        (prefix / _READY).touch()
    except (OSError, subprocess.SubprocessError) as error:
        said = log.read_text(errors="replace").strip()[-500:] if log.exists() else ""
        raise FMULoadError(printable(f"Wine cannot make its folder: {error} {said}")) from None


def _link_libraries(prefix: Path) -> None:
    """Replace the copies of Wine's own libraries by links, or else they take 700 MB."""
    originals = {path.name: path for place in _LIBRARIES for path in Path("/").glob(place)}
    for copy in (prefix / "drive_c" / "windows").glob("**/*.*"):
        original = originals.get(copy.name)
        if original is None or copy.is_symlink() or not copy.is_file():
            continue
        if filecmp.cmp(copy, original, shallow=False):
            copy.unlink()
            copy.symlink_to(original)
