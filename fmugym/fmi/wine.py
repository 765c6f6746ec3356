"""Wine, which runs Windows libraries on Linux: its finder, its prefix, and its worker program.

The worker program loads the libraries. ``ziglang`` from PyPI compiles it from the sources of the C
extension where it is first needed. It is kept in the cache folder, under a name that stands for its
sources and its compiler.

The prefix is a folder with Wine's registry and system libraries. Each version of Wine gets one of
this package's own, which is made once. Nothing in it opens a window, asks the network, or runs in
the background.
"""

from __future__ import annotations

import contextlib
import filecmp
import functools
import hashlib
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import quote

import fmpy

from fmugym.errors import FMULoadError, printable
from fmugym.files import cache_folder, own_prefix, sweep

__all__ = [
    "Wine",
    "alone",
    "can_run_windows",
    "find_wine",
    "is_buildable",
    "known_program",
    "obstacle_to_wine",
    "sources",
    "sources_digest",
    "windows_path",
    "windows_uri",
    "wine_folder",
    "wine_version",
    "worker_program",
]

if sys.platform != "win32":
    import fcntl

logger = logging.getLogger(__name__)

_PACKAGE: Final = Path(__file__).parent.parent
_FOLDERS: Final = (_PACKAGE / "native_sources", _PACKAGE.parent / "native")
"""In an installed package, and in a checkout of the repository."""

_OPTIONS: Final = (
    *("-target", "x86_64-windows-gnu", "-std=gnu11", "-O2", "-g0", "-s"),
    *("-ffp-contract=off", "-fno-math-errno"),
)
"""Options of the compiler; the arithmetic is that of the extension, see ``setup.py``."""

_LONGEST_BUILD: Final = 900.0
"""Seconds; ziglang's first build for Windows takes some two minutes, later ones ten seconds."""


def wine_folder() -> Path:
    """The folder for the program and for Wine's own files, in the cache folder.

    Raises:
        FMULoadError: If there can be none.
    """
    try:
        return cache_folder("wine").absolute()
    except OSError as error:
        raise FMULoadError(f"Wine needs a folder in the cache folder: {error}") from None


@contextlib.contextmanager
def alone(name: str) -> Iterator[None]:
    """Let only one process at a time do something; the others wait until it is done."""
    with (wine_folder() / f"{name}.lock").open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # closing the file frees it
        yield


@functools.cache
def sources() -> tuple[Path, ...]:
    """The C files of the program and their headers; empty if they are not installed."""
    for folder in _FOLDERS:
        found = [p for p in folder.glob("*/*.[ch]") if p.parent.name != "python"]
        if found:
            return tuple(sorted(found))
    return ()


def _top() -> str:
    """The folder above all sources, whose name differs in a checkout."""
    return os.path.commonpath(sources()) if sources() else ""


@functools.cache
def sources_digest() -> str:
    """Digest of the sources and the options of the compiler."""
    digest = hashlib.sha256(repr(_OPTIONS).encode())
    for path in sources():
        digest.update(f"{path.relative_to(_top()).as_posix()}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _compiler_version() -> str:
    """The version of ziglang; "" if it is not installed."""
    try:
        return version("ziglang")
    except PackageNotFoundError:
        return ""


def is_buildable() -> bool:
    """Whether the program can be built here."""
    return bool(_compiler_version() and sources())


def known_program() -> Path | None:
    """Find a program that was built before; without a compiler, any version counts."""
    with contextlib.suppress(FMULoadError):
        found = sorted(
            wine_folder().glob(f"worker-{sources_digest()}-{_compiler_version() or '*'}.exe")
        )
        return found[-1] if found else None
    return None


def worker_program() -> Path:
    """Return the program, which is built if there is none yet.

    Raises:
        FMULoadError: If it cannot be built.
    """
    program = known_program()
    if program is not None:
        return program
    with alone("worker"):
        return known_program() or _build()


def _build() -> Path:
    if not is_buildable():
        what = "ziglang, which builds" if sources() else "the C sources of"
        raise FMULoadError(f"{what} the worker program for Windows libraries, is not installed")
    target = wine_folder() / f"worker-{sources_digest()}-{_compiler_version()}.exe"
    logger.warning("building the worker program for Windows libraries, once; it takes some minutes")
    sweep(target.parent)
    with tempfile.TemporaryDirectory(prefix=own_prefix(), dir=target.parent) as folder:
        built = Path(folder) / "worker.exe"
        _compile(built)
        os.replace(built, target)
    return target


def _compile(target: Path) -> None:
    files = [str(path) for path in sources() if path.suffix == ".c"]
    options = (*_OPTIONS, f"-I{_top()}")
    command = [sys.executable, "-m", "ziglang", "cc", *options, *files, "-o", str(target)]
    try:
        subprocess.run(
            command,
            cwd=target.parent,
            check=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=_LONGEST_BUILD,
        )
    except subprocess.CalledProcessError as error:
        raise _build_failed(error.output.decode(errors="replace").strip()[-2000:]) from None
    except subprocess.TimeoutExpired:
        raise _build_failed(f"the compiler took longer than {_LONGEST_BUILD:g} s") from None
    except OSError as error:
        raise _build_failed(str(error)) from None


def _build_failed(why: str) -> FMULoadError:
    return FMULoadError(
        printable(f"the worker program for Windows libraries cannot be built: {why}")
    )


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
