"""``fmugym compile``: a library for this machine from the source code in an FMU.

FMI 2.0 lists the source files in the model description, FMI 3.0 in
``sources/buildDescription.xml``. FMI 1.0 has no list. FMPy builds FMUs, too, but leaves
prefixes in the names of functions and knows no folders of headers; OpenModelica's code has both.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

import fmpy
from lxml import etree

from fmugym.archive.description import INTERFACES
from fmugym.archive.fmu import FMU
from fmugym.archive.safe_zip import SafeZip
from fmugym.errors import ConfigError, FMULoadError, reason
from fmugym.signals import ordinary
from fmugym.tools.compilers import find_compiler

__all__ = ["compile_fmu"]

_BUILD_DESCRIPTION: Final = "sources/buildDescription.xml"
_LONGEST: Final = 16 * 2**20
_ELEMENTS: Final = {"co_simulation": "CoSimulation", "model_exchange": "ModelExchange"}
_CPP: Final = {".cpp", ".cc", ".cxx", ".c++"}
_LANGUAGE: Final = re.compile(r"C(\+\+)?(\d\d)")
_OPTIONS: Final = ("-O2", "-g0", "-fPIC", "-w", "-ffp-contract=off", "-fno-math-errno")
_COMPILERS: Final = {None, "gcc", "clang"}
_WORST_LINES: Final = 12
"""Of the compiler's output in an error."""


@dataclass(frozen=True)
class _FileSet:
    """Source files that are compiled alike.

    Attributes:
        files, folders: Relative to ``sources/``.
    """

    files: tuple[str, ...]
    options: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Build:
    """How one library is built."""

    identifier: str
    sets: tuple[_FileSet, ...]
    libraries: tuple[str, ...] = field(default=())


def compile_fmu(path: Path, output: Path | None = None) -> Path:
    """Compile the source code in an FMU, and write a copy of the FMU with the library.

    The compiler is the system's, or else ziglang. The code is foreign: some compilers run parts of
    what they compile, and whoever loads the library runs it.

    Args:
        path: The FMU.
        output: The new FMU; by default beside the old one, with the platform in its name.

    Returns:
        The path of the new FMU.

    Raises:
        ConfigError: If the new file exists, or there is no compiler.
        FMULoadError: If the FMU has no source code or no list of it, or if it cannot be compiled.
    """
    fmu = FMU(path)
    archive = SafeZip(fmu.path, fmu.limits)
    platform = fmu.description.platform
    output = path.with_name(f"{path.stem}_{platform}.fmu") if output is None else output
    if output.exists():
        raise ConfigError(f"{output} exists already")
    builds = _builds(fmu, archive)
    with tempfile.TemporaryDirectory(prefix="fmugym-compile-") as name:
        folder = Path(name)
        places = [p for p in archive.files if p.startswith(("sources/", f"binaries/{platform}/"))]
        archive.extract(folder, {place: place for place in places})
        libraries = {
            f"binaries/{platform}/{build.identifier}{fmpy.sharedLibraryExtension}": _library(
                fmu, folder, build
            )
            for build in builds
        }
        _write(SafeZip(fmu.path, fmu.limits), output, libraries)
    return output


# What is to be compiled


def _builds(fmu: FMU, archive: SafeZip) -> list[_Build]:
    identifiers = _identifiers(fmu)
    if _BUILD_DESCRIPTION in archive.files:
        root = _parse(archive, _BUILD_DESCRIPTION)
        found = [_described(root, identifier, fmu) for identifier in identifiers]
    else:
        root = _parse(archive, "modelDescription.xml")
        found = [_listed(root, identifier) for identifier in identifiers]
    builds = [build for build in found if build is not None]
    if not builds:
        there = any(place.startswith("sources/") for place in archive.files)
        raise FMULoadError(
            f"{fmu.path.name} cannot be compiled: it has "
            + ("no list of its source files" if there else "no source code")
            + "; export it with source code, or for this platform"
        )
    for build in builds:
        _require_files(fmu, archive, build)
    return builds


def _identifiers(fmu: FMU) -> list[str]:
    """The model identifiers of the interfaces, each once."""
    identifiers: dict[str, None] = {}
    for interface in INTERFACES:
        try:
            other = FMU(fmu.path, limits=fmu.limits, interface=interface)
        except FMULoadError:  # it does not have this interface
            continue
        identifiers[other.description.model_identifier] = None
    return list(identifiers)


def _parse(archive: SafeZip, place: str) -> Any:
    content = archive.read(place, _LONGEST)
    if len(content) > _LONGEST or b"<!DOCTYPE" in content.upper():
        raise FMULoadError(f"{archive.path.name}: {place} is too long or has a DOCTYPE")
    try:
        return etree.fromstring(content, etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        raise FMULoadError(f"{archive.path.name}: {place} is not XML: {reason(error)}") from None


def _listed(root: Any, identifier: str) -> _Build | None:
    """By the model description of FMI 2.0."""
    for element in _ELEMENTS.values():
        interface = root.find(element)
        if interface is not None and interface.get("modelIdentifier") == identifier:
            names = tuple(f.get("name", "") for f in interface.findall("SourceFiles/File"))
            return _Build(identifier, (_FileSet(names),)) if names else None
    return None


def _described(root: Any, identifier: str, fmu: FMU) -> _Build | None:
    """By the build description of FMI 3.0, which FMUs of FMI 2.0 may have, too."""
    for build in root.findall("BuildConfiguration"):
        fits = build.get("platform") in {None, fmpy.platform_tuple, fmu.description.platform}
        if build.get("modelIdentifier") == identifier and fits:
            libraries = tuple(one.get("name", "") for one in build.findall("Library"))
            sets = tuple(_file_set(one) for one in build.findall("SourceFileSet"))
            return _Build(identifier, sets, libraries)
    return None


def _file_set(element: Any) -> _FileSet:
    definitions = [
        f"-D{one.get('name')}" + ("" if one.get("value") is None else f"={one.get('value')}")
        for one in element.findall("PreprocessorDefinition")
        if one.get("optional") not in {"true", "1"}
    ]
    language = _LANGUAGE.fullmatch(element.get("language") or "")
    standard = [] if language is None else [f"-std=gnu{language[1] or ''}{language[2]}"]
    fits = element.get("compiler") in _COMPILERS
    options = shlex.split(element.get("compilerOptions") or "") if fits else []
    return _FileSet(
        tuple(one.get("name", "") for one in element.findall("SourceFile")),
        (*standard, *options, *definitions),
        tuple(one.get("name", "") for one in element.findall("IncludeDirectory")),
    )


def _require_files(fmu: FMU, archive: SafeZip, build: _Build) -> None:
    for name in (name for one in build.sets for name in (*one.files, *one.folders)):
        if not name or name.startswith("/") or ".." in PurePosixPath(name).parts:
            raise FMULoadError(f"{fmu.path.name}: {name!r} is no file in its sources")
    for name in (name for one in build.sets for name in one.files):
        if f"sources/{PurePosixPath(name)}" not in archive.files:
            raise FMULoadError(f"{fmu.path.name} lacks the source file 'sources/{name}'")


# Compiling


def _library(fmu: FMU, folder: Path, build: _Build) -> bytes:
    """Compile one library."""
    objects = [
        _object(fmu, folder, one, name, f"{i}_{j}.o")
        for i, one in enumerate(build.sets)
        for j, name in enumerate(one.files)
    ]
    languages = {_language(name) for one in build.sets for name in one.files}
    language = "C++" if "C++" in languages else "C"
    made = f"{build.identifier}{fmpy.sharedLibraryExtension}"
    _run(
        fmu,
        folder,
        [
            *find_compiler(f"{fmu.path.name}", language),
            *("-shared", *objects, "-o", made),
            *(f"-L{folder / 'binaries' / fmu.description.platform}", "-lm"),
            *(f"-l{name}" for name in build.libraries),
        ],
    )
    return (folder / made).read_bytes()


def _language(name: str) -> str:
    return "C++" if PurePosixPath(name).suffix.casefold() in _CPP else "C"


def _object(fmu: FMU, folder: Path, one: _FileSet, name: str, target: str) -> str:
    """Compile one source file. Its functions get the names of the standard, without a prefix."""
    sources = folder / "sources"
    version = fmu.description.fmi_major_version
    command = [
        *find_compiler(f"{fmu.path.name}", _language(name)),
        *_OPTIONS,
        *one.options,
        *(f"-DFMI{version}_OVERRIDE_FUNCTION_PREFIX", f"-I{sources}"),
        *(f"-I{sources / inside}" for inside in one.folders),
        *("-idirafter", str(_headers()), "-c", str(sources / name), "-o", target),
    ]
    _run(fmu, folder, command)
    return target


def _headers() -> Path:
    """The folder with the headers of the standard, which FMPy has; the FMU's own come first."""
    return Path(fmpy.__file__).parent / "c-code"


def _run(fmu: FMU, folder: Path, command: Sequence[str]) -> None:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, errors="replace", check=False
    )
    if done.returncode:
        lines = (done.stderr or done.stdout).replace(str(folder), "").strip().splitlines()
        told = " | ".join(lines[:_WORST_LINES])
        raise FMULoadError(f"{fmu.path.name} cannot be compiled: {told}")


def _write(archive: SafeZip, output: Path, libraries: Mapping[str, bytes]) -> None:
    """Copy an archive with more libraries. What is there half is removed."""
    try:
        with output.open("xb") as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as copy:
            for place in archive.files:
                if place not in libraries:
                    with archive.open(place) as source, copy.open(place, "w") as target:
                        shutil.copyfileobj(source, target)
            for place, content in libraries.items():
                copy.writestr(place, content)
    except FileExistsError:
        raise ConfigError(f"{output} exists already") from None
    except ordinary(OSError) as error:
        raise ConfigError(f"{output} cannot be written: {reason(error)}") from None
    except BaseException:
        output.unlink(missing_ok=True)
        raise
