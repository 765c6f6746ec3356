"""A stand-in for the Fortran run-time libraries that no current distribution has.

Many FMUs of older tools need ``libgfortran.so.3`` or ``libgfortran.so.4`` and call none of its
functions, or only a few simple ones. ``build_stand_in`` looks up which symbols with which versions
an FMU asks for, and builds a small shared library that has them. Functions that the stand-in lacks
end the process with a message when they are called: nothing is ever computed wrongly.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Final

from fmugym.errors import ConfigError, FMULoadError
from fmugym.extras import c_compiler
from fmugym.fmi.binaries import opened
from fmugym.fmi.fmu import FMU
from fmugym.fmi.library_dependencies import libraries_of

__all__ = ["LIBRARIES", "StandIn", "build_stand_in", "replaceable"]

LIBRARIES: Final = {"libgfortran.so.3": "GFORTRAN_1.0", "libgfortran.so.4": "GFORTRAN_7"}
"""The libraries that can be replaced, each with its first symbol version."""


class StandIn:
    """A library that was built.

    Attributes:
        path: Path.
        served: The symbols for which it has a function.
        lacking: The symbols that end the process when they are called.
    """

    def __init__(self, path: Path, symbols: Iterable[str]) -> None:
        known = _served()
        self.path = path
        self.served = tuple(sorted(known.intersection(symbols)))
        self.lacking = tuple(sorted(set(symbols) - known))


def replaceable(fmu: FMU) -> tuple[str, ...]:
    """The missing libraries of an FMU for which a stand-in can be built."""
    return tuple(name for name in fmu.missing_libraries if name in LIBRARIES)


def build_stand_in(fmu: FMU, folder: Path) -> tuple[StandIn, ...]:
    """Build a stand-in for each of the old Fortran libraries that an FMU needs.

    Args:
        fmu: The FMU; nothing of it is executed.
        folder: Where to write the libraries, under the names that the FMU asks for. It is made if
            it does not exist.

    Returns:
        What was built; name the paths in ``preload``.

    Raises:
        ConfigError: If the FMU lacks no such library, a file is already there, the folder cannot be
            used, or there is no C compiler.
        FMULoadError: If a library of the FMU is damaged, or the compiler fails.
    """
    names = replaceable(fmu)
    if not names:
        raise ConfigError(
            f"{fmu.path.name} lacks neither {' nor '.join(LIBRARIES)}; it needs no stand-in"
        )
    paths = [folder.absolute() / name for name in names]  # a bare name would be searched for
    for path in paths:
        if path.exists():
            raise ConfigError(f"{path} exists already")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder} cannot hold libraries: {error}") from None
    return tuple(_build(fmu, path) for path in paths)


def _build(fmu: FMU, path: Path) -> StandIn:
    symbols: dict[str, str] = {}
    for library in libraries_of(fmu.extract() / fmu.library):
        with opened(library) as elf:
            symbols |= elf.needed_symbols(path.name)
            symbols |= dict.fromkeys(
                (s for s in elf.unversioned_symbols() if s.startswith("_gfortran_")),
                LIBRARIES[path.name],
            )
    _compile(path, symbols)
    return StandIn(path, symbols)


def _compile(path: Path, symbols: Mapping[str, str]) -> None:
    with tempfile.TemporaryDirectory(prefix="fmugym-stand-in-") as name:
        folder = Path(name)
        (folder / "fortran_libraries.c").write_text(_source())
        (folder / "lacking.c").write_text(_lacking(set(symbols) - _served()))
        (folder / "versions").write_text(_versions(symbols, LIBRARIES[path.name]))
        command = [
            *c_compiler("a stand-in"),
            *("-shared", "-fPIC", "-O1", "-w", "fortran_libraries.c", "lacking.c", "-o", "library"),
            *(f"-Wl,-soname,{path.name}", "-Wl,--version-script=versions"),
        ]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise FMULoadError(f"{path.name} cannot be built: {done.stderr[-500:]}")
        shutil.copyfile(folder / "library", path)


def _source() -> str:
    return (resources.files("fmugym.fmi") / "fortran_libraries.c").read_text()


def _served() -> set[str]:
    """The functions of ``fortran_libraries.c``."""
    return set(re.findall(r"^\w+ (_gfortran_\w+)\(", _source(), re.MULTILINE))


def _lacking(symbols: Iterable[str]) -> str:
    """The functions that say that they are not there; symbols are C identifiers in ELF files."""
    bad = [symbol for symbol in symbols if not re.fullmatch(r"\w+", symbol, re.ASCII)]
    if bad:
        raise FMULoadError(f"the symbol {bad[0]!r} cannot be replaced: it is not a C identifier")
    lines = [f'void {s}(void) {{ fmugym_no_such_function("{s}"); }}' for s in sorted(symbols)]
    return "\n".join(["void fmugym_no_such_function(const char *name);", *lines, ""])


def _versions(symbols: Mapping[str, str], first: str) -> str:
    """The linker's version script: the loader compares versions by their names only."""
    nodes: dict[str, list[str]] = {first: []}
    for symbol, version in sorted(symbols.items()):
        if not re.fullmatch(r"[\w.]+", version, re.ASCII):
            raise FMULoadError(f"the version {version!r} of {symbol!r} is not a name")
        nodes.setdefault(version, []).append(symbol)
    hidden = "local: *;"
    lines = []
    for version, names in nodes.items():
        shown = f"global: {' '.join(f'{name};' for name in names)} " if names else ""
        lines.append(f"{version} {{ {shown}{hidden} }};")
        hidden = ""
    return "\n".join([*lines, ""])
