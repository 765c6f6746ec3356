"""Where the libraries and tools come from that an FMU needs."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from typing import Final, NamedTuple

__all__ = ["Source", "describe_missing", "missing_tool", "source_of"]


class Source(NamedTuple):
    """Where a library comes from; an empty text where no package is known.

    Attributes:
        debian: The package of Debian and Ubuntu.
        conda: The package of conda-forge.
        note: What else to know, as a sentence without its full stop.
    """

    debian: str = ""
    conda: str = ""
    note: str = ""


_STAND_IN: Final = "no current distribution has it; 'fmugym stand-in FMU' makes a replacement"

_MATCHING: Final = "the version must match"

_ROWS: Final[tuple[tuple[str, ...], ...]] = (
    (r"libgfortran\.so\.3", "", "libgfortran=3", _STAND_IN),
    (r"libgfortran\.so\.4", "", "libgfortran-ng=7", _STAND_IN),
    (r"libgfortran\.so\.5", "libgfortran5", "libgfortran5"),
    (r"libquadmath\.so\.0", "libquadmath0", "libquadmath"),
    (r"libgomp\.so\.1", "libgomp1", "libgomp"),
    (r"libgcc_s\.so\.1", "libgcc-s1", "libgcc"),
    (r"libstdc\+\+\.so\.6", "libstdc++6", "libstdcxx"),
    (r"libstdc\+\+\.so\.5", "libstdc++5"),
    (r"libblas\.so\.3", "libblas3", "libblas"),
    (r"liblapack\.so\.3", "liblapack3", "liblapack"),
    (r"libopenblas\.so\.0", "libopenblas0", "libopenblas"),
    (r"libsundials_.*\.so.*", "libsundials-dev", "sundials", _MATCHING),
    (r"libklu\.so.*", "libsuitesparse-dev", "suitesparse", _MATCHING),
    (r"libsuperlu\.so.*", "libsuperlu-dev", "superlu", _MATCHING),
    (r"libhdf5.*\.so.*", "libhdf5-dev", "hdf5", _MATCHING),
    (r"libxml2\.so\.2", "libxml2", "libxml2"),
    (r"libexpat\.so\.1", "libexpat1", "libexpat"),
    (r"libz\.so\.1", "zlib1g", "libzlib"),
    (r"libcurl\.so\.4", "libcurl4", "libcurl"),
    (r"lib(ssl|crypto)\.so\.3", "libssl3", "openssl=3"),
    (r"lib(ssl|crypto)\.so\.1\.1", "", "openssl=1.1", "Debian had it up to release 11"),
    (r"lib(ssl|crypto)\.so\.1\.0.*", "", "openssl=1.0", "Debian had it up to release 9"),
    (r"libtbb\.so\.2", "libtbb2", "tbb=2020", "Debian had it up to release 11"),
    (r"libtbb\.so\.12", "libtbb12", "tbb"),
    (r"libQt5.*\.so\.5", "libqt5core5a", "qt-main=5", "Debian has a package a module"),
    (r"libQt6.*\.so\.6", "libqt6core6", "qt6-main", "Debian has a package a module"),
    (r"libboost_.*\.so.*", "libboost-all-dev", "libboost", _MATCHING),
    (r"libjvm\.so", "default-jre-headless", "openjdk", "its folder must be searched"),
    (r"libpython3\.\d+m?\.so\..*", "", "python", _MATCHING),
    (r"libtinfo\.so\.5", "libtinfo5", "ncurses=5"),
    (r"libncurses\.so\.5", "libncurses5", "ncurses=5"),
    (r"libnsl\.so\.1", "libc6", "libnsl"),
    (r"libcrypt\.so\.1", "libcrypt1", "libxcrypt"),
    (r"libX11\.so\.6", "libx11-6", "xorg-libx11"),
    (r"libGL\.so\.1", "libgl1", "libgl"),
    (r"libmw.*\.so.*|libmx\.so|libmex\.so", "", "", "it belongs to MATLAB or its free runtime"),
    (r"ld-musl-.*", "musl", "", "the FMU was built for Alpine Linux"),
)
"""A pattern of names of libraries, and the fields of their ``Source``."""

_SOURCES: Final = tuple((re.compile(pattern), Source(*fields)) for pattern, *fields in _ROWS)


_TOOLS: Final = (
    (r"energyplus", "EnergyPlus", "energyplus"),
    (r"overture|into-cps|vdmj", "Java", "java"),
    (r"fmi4j|fmu4j|javafmi", "Java", "java"),
    (r"matlab|simulink", "MATLAB", "matlab"),
    (r"scilab|xcos", "Scilab", "scilab"),
)
"""Pattern of the generation tool, the tool that such an FMU starts, and its program."""

_START_ALWAYS: Final = {"EnergyPlus", "Java"}
"""Tools whose FMUs start them without saying so by ``needsExecutionTool``."""


def missing_tool(generation_tool: str, needs_execution_tool: bool) -> str | None:
    """Name the tool that an FMU starts, unless its program is found.

    Args:
        generation_tool: The tool that made the FMU, the only hint at what it starts.
        needs_execution_tool: The FMU's flag.

    Returns:
        The tool, or None if the FMU starts none or its program is in the search path.
    """
    for pattern, tool, program in _TOOLS:
        if re.search(pattern, generation_tool, re.IGNORECASE):
            needed = needs_execution_tool or tool in _START_ALWAYS
            return tool if needed and shutil.which(program) is None else None
    return (generation_tool or "the tool that exported it") if needs_execution_tool else None


def source_of(library: str) -> Source:
    """Look up where a library comes from.

    Args:
        library: Its name, for example ``libgfortran.so.5``.

    Returns:
        The packages; empty texts if the library is not known.
    """
    return next((source for names, source in _SOURCES if names.fullmatch(library)), Source())


def describe_missing(fmu: str, libraries: Sequence[str]) -> str:
    """Say which libraries an FMU of this name misses, and what to do about it."""
    listing = "; ".join(f"{name}{_remark(source_of(name))}" for name in libraries)
    return (
        f"{fmu} needs shared libraries that are not found here: {listing}. Install them, or name "
        "their files in preload=[...]"
    )


def _remark(source: Source) -> str:
    packages = [
        f"{system} {package}"
        for system, package in (("Debian", source.debian), ("conda-forge", source.conda))
        if package
    ]
    remark = ", ".join([*packages, source.note] if source.note else packages)
    return f" ({remark})" if remark else ""
