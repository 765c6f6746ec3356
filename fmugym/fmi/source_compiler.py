"""Compiler of an FMU's own source code for this machine, by FMPy's CMake project.

FMI 2.0 lists the source files in the model description, FMI 3.0 in
``sources/buildDescription.xml``. FMI 1.0 has no list. FMPy's own call of its project accepts valid
descriptions only, knows no folders of headers, and leaves prefixes in the names of functions. FMUs
that people have break rules, and OpenModelica's code has such folders and prefixes.
"""

from __future__ import annotations

import os
import subprocess
import sysconfig
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import fmpy
from fmpy.model_description import read_build_description
from fmpy.util import create_zip_archive

from fmugym.errors import ConfigError, FMULoadError, reason
from fmugym.fmi.description_reader import read_xml
from fmugym.fmi.fmu import FMU
from fmugym.fmi.safe_zip import SafeZip

__all__ = ["compile_fmu"]

_BUILD_DESCRIPTION: Final = "sources/buildDescription.xml"
_MOST_LINES: Final = 12
"""Of the compiler's output in an error."""


def compile_fmu(path: Path, output: Path | None = None) -> Path:
    """Compile the source code in an FMU, and write a copy of the FMU with the library.

    The code is foreign: some compilers run parts of what they compile, and whoever loads the
    library runs it.

    Args:
        path: The FMU.
        output: The new FMU; by default beside the old one, with the platform in its name.

    Returns:
        The path of the new FMU.

    Raises:
        ConfigError: If the new file exists or cannot be written, or there is no CMake.
        FMULoadError: If the FMU has no source code or no list of it, or if it cannot be compiled.
    """
    fmu = FMU(path)
    archive = SafeZip(fmu.path, fmu.limits)
    if output is None:
        output = path.with_name(f"{path.stem}_{fmu.description.platform}.fmu")
    if output.exists():
        raise ConfigError(f"{output} exists already")
    if _BUILD_DESCRIPTION in archive.files:
        read_xml(archive, _BUILD_DESCRIPTION, fmu.limits.max_xml_bytes)
    with tempfile.TemporaryDirectory(prefix="fmugym-compile-") as name:
        folder = Path(name).resolve() / "fmu"
        archive.extract(folder, {place: place for place in archive.files})
        _build(fmu, folder, _options(fmu, folder, _source_files(fmu, folder)))
        _write(folder, output)
    return output


def _source_files(fmu: FMU, folder: Path) -> Any:
    """Source files that are compiled together, and their options, as FMPy reads them.

    Raises:
        FMULoadError: If there are none, or several that are compiled in different ways.
    """
    try:
        listed = read_build_description(folder, validate=False)
        listed += fmpy.read_model_description(folder, validate=False).buildConfigurations
    except Exception as error:  # FMPy leaks a dozen types for malformed files
        raise _refusal(fmu, f"its source files are not known: {reason(error)}") from None
    identifier = fmu.description.model_identifier
    sets = [one.sourceFileSets for one in listed if one.modelIdentifier == identifier]
    if not sets:
        lacks = "list of its source files" if (folder / "sources").is_dir() else "source code"
        raise _refusal(fmu, f"it has no {lacks}; export it with source code, or for this platform")
    if len(sets[0]) != 1:
        raise _refusal(fmu, f"it has {len(sets[0])} sets of source files, expected one")
    return sets[0][0]


def _options(fmu: FMU, folder: Path, files: Any) -> dict[str, str]:
    """The variables of FMPy's project."""
    sources, about = folder / "sources", fmu.description
    for name in files.sourceFiles:
        place = (sources / name).resolve()
        if not (place.is_relative_to(sources) and place.is_file()):
            raise FMULoadError(f"{fmu.path.name} lacks the source file 'sources/{name}'")
    macros = [
        one.name if one.value is None else f"{one.name}={one.value}"
        for one in files.preprocessorDefinitions
        if not one.optional
    ]
    macros.append(f"FMI{about.fmi_major_version}_OVERRIDE_FUNCTION_PREFIX")
    return {
        "CMAKE_BUILD_TYPE": "Release",
        "CMAKE_C_STANDARD_LIBRARIES": "" if os.name == "nt" else "-lm",
        "CMAKE_CXX_STANDARD": (files.language or "").partition("C++")[2] or "17",
        "FMI_MODEL_IDENTIFIER": about.model_identifier,
        "FMI_SOURCES": ";".join((sources / name).as_posix() for name in files.sourceFiles),
        "FMI_INCLUDE_DIRS": ";".join(
            (sources / name).as_posix() for name in ("", *files.includeDirectories)
        ),
        "FMI_DEFINITIONS": ";".join(macros),
        "FMI_TARGET_DIR": (folder / "binaries" / about.platform).as_posix(),
    }


def _build(fmu: FMU, folder: Path, options: dict[str, str]) -> None:
    """Add the library to the files of an FMU."""
    project, build = Path(fmpy.__file__).parent / "c-code", folder.with_name("build")
    variables = [f"-D{name}={value}" for name, value in options.items()]
    _cmake(fmu, folder, ["-S", str(project), "-B", str(build), *variables])
    _cmake(fmu, folder, ["--build", str(build), "--target", "install", "--config", "Release"])


def _cmake(fmu: FMU, folder: Path, arguments: Sequence[str]) -> None:
    """Run CMake, which comes with FMPy: on the path, or among the programs of pip."""
    path = f"{sysconfig.get_path('scripts')}{os.pathsep}{os.environ.get('PATH', '')}"
    try:
        done = subprocess.run(
            ["cmake", *arguments],
            env=os.environ | {"PATH": path},
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
        )
    except FileNotFoundError:
        raise ConfigError("compile needs CMake: pip install cmake") from None
    if done.returncode:
        lines = (done.stderr or done.stdout).replace(str(folder), "").strip().splitlines()
        raise _refusal(fmu, " | ".join(lines[:_MOST_LINES]))


def _refusal(fmu: FMU, why: str) -> FMULoadError:
    return FMULoadError(f"{fmu.path.name} cannot be compiled: {why}")


def _write(folder: Path, output: Path) -> None:
    """Pack an FMU; a half-written one is removed."""
    try:
        with output.open("xb") as file:
            create_zip_archive(file, folder)
    except FileExistsError:
        raise ConfigError(f"{output} exists already") from None
    except OSError as error:
        raise ConfigError(f"{output} cannot be written: {reason(error)}") from None
    except BaseException:
        output.unlink(missing_ok=True)
        raise
