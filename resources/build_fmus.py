"""Builds the bundled FMUs: `python resources/build_fmus.py`.

The build needs two packages from PyPI and no system compiler: `ziglang` cross-compiles for all
platforms, and the wheel of `fmpy` contains the FMI headers. The same sources and the same version
of `ziglang` give the same bytes on every machine.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
from itertools import product
from pathlib import Path
from typing import NamedTuple

RESOURCES = Path(__file__).resolve().parent
MODELS = ("CartPole", "Pendulum", "DoublePendulum", "House")
FMI_VERSIONS = ("1.0", "2.0", "3.0")


class Platform(NamedTuple):
    """A platform to build for.

    Attributes:
        target: zig's target triple.
        extension: the file name extension of shared libraries.
        folder: the platform's folder in FMI 1.0 and 2.0; None if these versions do not have one.
        folder_fmi3: the platform's folder in FMI 3.0.
    """

    target: str
    extension: str
    folder: str | None
    folder_fmi3: str


PLATFORMS = {
    "x86_64-linux": Platform("x86_64-linux-gnu.2.17", ".so", "linux64", "x86_64-linux"),
    "aarch64-linux": Platform("aarch64-linux-gnu.2.17", ".so", None, "aarch64-linux"),
    "x86_64-windows": Platform("x86_64-windows-gnu", ".dll", "win64", "x86_64-windows"),
    "x86_64-darwin": Platform("x86_64-macos.10.13", ".dylib", "darwin64", "x86_64-darwin"),
    "aarch64-darwin": Platform("aarch64-macos.11.0", ".dylib", "darwin64", "aarch64-darwin"),
}

COMPILER_OPTIONS = [
    *("-std=c23", "-Wall", "-Wextra", "-Wpedantic", "-Werror"),
    *("-O2", "-g0", "-fomit-frame-pointer", "-ffp-contract=off", "-fno-math-errno"),
    *("-shared", "-fPIC", "-fvisibility=hidden"),
    *("-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections", "-s"),
]


def header_folder() -> Path:
    """Return the folder with the FMI headers, in the installed fmpy package."""
    spec = importlib.util.find_spec("fmpy")
    if spec is None or spec.origin is None:
        raise SystemExit("the FMI headers come with fmpy: pip install fmpy")
    return Path(spec.origin).parent / "c-code"


def description_file(model: str, fmi_version: str) -> Path:
    """Return the path of a model description; some models lack one for some FMI versions."""
    return RESOURCES / model / f"FMI{fmi_version[0]}.xml"


def build_library(model: str, fmi_version: str, platform: str, folder: Path) -> Path:
    """Compile one shared library.

    Args:
        model: the name of the model, one of MODELS.
        fmi_version: one of FMI_VERSIONS.
        platform: a key of PLATFORMS.
        folder: where to put the library.

    Returns:
        The path of the library, whose file name is the model's name.
    """
    target, extension, _, _ = PLATFORMS[platform]
    command = [sys.executable, "-m", "ziglang", "cc", "-target", target, *COMPILER_OPTIONS]
    command += [f"-DFMI_VERSION={fmi_version[0]}", f"-I{model}", "-Isrc"]
    command += ["-isystem", str(header_folder()), "src/fmu.c", "-lm"]
    if extension == ".dylib":  # otherwise the library contains the path of the output file
        command.append(f"-Wl,-install_name,@rpath/{model}{extension}")
    # zig writes import libraries and debug files next to a DLL, so only the library is copied
    with tempfile.TemporaryDirectory() as scratch:
        library = Path(scratch) / f"{model}{extension}"
        subprocess.run([*command, "-o", str(library)], cwd=RESOURCES, check=True)
        folder.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copy(library, folder / library.name))


def universal_binary(libraries: list[bytes]) -> bytes:
    """Join Mach-O libraries of several architectures into one (Apple's mach-o/fat.h).

    Args:
        libraries: the contents of the libraries. Each begins with magic, CPU type and CPU subtype.
    """
    alignment = 14  # as a power of two: the page size of arm64
    header = struct.pack(">II", 0xCAFEBABE, len(libraries))
    body = b""
    for library in libraries:
        offset = 1 << alignment if not body else -(-len(body) // (1 << alignment)) << alignment
        body = body.ljust(offset, b"\0") + library
        _, cpu_type, cpu_subtype = struct.unpack_from("<III", library)
        header += struct.pack(">IIIII", cpu_type, cpu_subtype, offset, len(library), alignment)
    return header + body[len(header) :]


def binaries(model: str, fmi_version: str, platforms: list[str]) -> dict[str, bytes]:
    """Return the libraries of one FMU by their path in the archive."""
    found: dict[str, list[bytes]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for name in platforms:
            platform = PLATFORMS[name]
            folder = platform.folder_fmi3 if fmi_version == "3.0" else platform.folder
            if folder is not None:
                library = build_library(model, fmi_version, name, Path(scratch) / name)
                found.setdefault(f"binaries/{folder}/{library.name}", []).append(
                    library.read_bytes()
                )
    return {
        path: parts[0] if len(parts) == 1 else universal_binary(parts)
        for path, parts in found.items()
    }


def write_archive(path: Path, files: dict[str, bytes]) -> None:
    """Write a zip file whose bytes depend on the names and contents of the files only.

    It is not compressed because the output of zlib differs between its versions.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        for name in sorted(files, key=lambda name: (name != "modelDescription.xml", name)):
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.create_system = 3  # Unix, also when built on Windows
            entry.external_attr = 0o100644 << 16
            archive.writestr(entry, files[name])


def build_fmu(model: str, fmi_version: str, platforms: list[str], output: Path) -> Path:
    """Build one FMU.

    Args:
        model: the name of the model, one of MODELS.
        fmi_version: one of FMI_VERSIONS for which the model has a description.
        platforms: keys of PLATFORMS.
        output: the folder for the FMUs; each FMI version has a subfolder.

    Returns:
        The path of the FMU.
    """
    path = output / fmi_version / f"{model}.fmu"
    files = {"modelDescription.xml": description_file(model, fmi_version).read_bytes()}
    write_archive(path, files | binaries(model, fmi_version, platforms))
    return path


def main() -> None:
    """Build the FMUs that the command line selects."""
    parser = argparse.ArgumentParser(description="Build the bundled FMUs (default: all of them).")
    parser.add_argument("--model", choices=MODELS, action="append")
    parser.add_argument("--fmi-version", choices=FMI_VERSIONS, action="append")
    parser.add_argument("--platform", choices=PLATFORMS, action="append")
    parser.add_argument("--output", type=Path, default=RESOURCES / "fmus", help="%(default)s")
    options = parser.parse_args()
    asked = product(options.model or MODELS, options.fmi_version or FMI_VERSIONS)
    pairs = [
        (model, version) for model, version in asked if description_file(model, version).exists()
    ]
    if not pairs:
        parser.error("this model does not exist in this FMI version")
    for model, version in pairs:
        path = build_fmu(model, version, options.platform or list(PLATFORMS), options.output)
        print(f"{path} ({path.stat().st_size / 1000:.0f} kB)")


if __name__ == "__main__":
    main()
