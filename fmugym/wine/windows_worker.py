"""Worker program for Windows, built from the sources of the C extension.

``ziglang`` from PyPI compiles it where it is first needed. The program is kept in the cache folder,
under a name that stands for its sources and its compiler.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from fmugym.caching import cache_folder, own_prefix, sweep
from fmugym.errors import FMULoadError, printable

if sys.platform != "win32":
    import fcntl

__all__ = ["alone", "is_buildable", "known_program", "sources", "wine_folder", "worker_program"]

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
        found = [*folder.glob("*.[ch]"), *folder.glob("worker/*.[ch]")]
        if found:
            return tuple(sorted(found))
    return ()


@functools.cache
def _digest() -> str:
    """Stands for the sources and the options."""
    digest = hashlib.sha256(repr(_OPTIONS).encode())
    folder = os.path.commonpath(sources()) if sources() else ""  # its name differs in a checkout
    for path in sources():
        digest.update(f"{path.relative_to(folder).as_posix()}\0".encode())
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
        found = sorted(wine_folder().glob(f"worker-{_digest()}-{_compiler_version() or '*'}.exe"))
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
    target = wine_folder() / f"worker-{_digest()}-{_compiler_version()}.exe"
    logger.warning("building the worker program for Windows libraries, once; it takes some minutes")
    sweep(target.parent)
    with tempfile.TemporaryDirectory(prefix=own_prefix(), dir=target.parent) as folder:
        built = Path(folder) / "worker.exe"
        _compile(built)
        os.replace(built, target)
    return target


def _compile(target: Path) -> None:
    files = [str(path) for path in sources() if path.suffix == ".c"]
    command = [sys.executable, "-m", "ziglang", "cc", *_OPTIONS, *files, "-o", str(target)]
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
