"""FMUs that have only libraries for Windows."""

import functools
import subprocess
import sys
import tempfile
from pathlib import Path

import building
import fmu_tools

from fmugym import FMU
from fmugym.wine.loader import can_run_windows, obstacle_to_wine


def why_not():
    """Why Windows libraries cannot run here; "" if they can."""
    if not can_run_windows():
        return "Windows libraries run in Wine on Linux on x86_64 only"
    obstacle = obstacle_to_wine()
    return f"Windows libraries run here in Wine: {obstacle}" if obstacle else ""


def for_windows(path, folder):
    """Copy an FMU with a library for Windows only: its own, or one built of a test's source."""
    files = fmu_tools.read_fmu(path)
    kept = {
        name: data
        for name, data in files.items()
        if not name.startswith("binaries/") or name.endswith(".dll")
    }
    if not any(name.endswith(".dll") for name in kept):
        description = FMU(path).description
        kept |= _library(description.model_identifier, description.fmi_major_version)
    return fmu_tools.write_fmu(Path(folder) / f"Windows{Path(path).name}", kept)


def _library(model, version):
    folder = "x86_64-windows" if version == 3 else "win64"
    data = windows_library(f"{model.lower()}.c", flags=(f"-DFMI_VERSION={version}",))
    return {f"binaries/{folder}/{model}.dll": data}


@functools.cache
def windows_library(source, flags=()):
    """The bytes of a library for Windows, made of a C file of this folder."""
    command = [sys.executable, "-m", "ziglang", "cc", "-target", "x86_64-windows-gnu"]
    command += ["-shared", "-O1", "-g0", "-ffp-contract=off", *flags, building.HERE / source]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "made.dll"
        subprocess.run([*command, "-o", target], check=True, cwd=folder)
        return target.read_bytes()
