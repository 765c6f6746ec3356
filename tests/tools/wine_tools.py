"""FMUs that have only libraries for Windows."""

import contextlib
import functools
import sys
from pathlib import Path

import building
import exchange_tools
import fmu_tools
import model_tools
import pytest

from fmugym import FMU
from fmugym.fmi.wine import can_run_windows, obstacle_to_wine

FOLDERS = {1: "win64", 2: "win64", 3: "x86_64-windows"}


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
    name, flags = model.lower(), (f"-DFMI_VERSION={version}",)
    with building_for_windows():
        if (building.HERE / f"zoo/{name}.c").exists():
            data = model_tools.library(version, name)
        else:
            data = building.library(f"sources/{name}.c", flags=flags)
    return {f"binaries/{FOLDERS[version]}/{model}.dll": data}


@functools.cache
def windows_library(*sources, flags=(), stubs=None):
    """The bytes of a library for Windows; the arguments are those of ``building.library``."""
    key = sources, flags, stubs
    command = [sys.executable, "-m", "ziglang", "cc", "-target", "x86_64-windows-gnu"]
    command += ["-shared", "-O1", "-g0", "-ffp-contract=off"]
    return building.once(key, ".dll", lambda path: building.compile_to(path, command, *key))


@contextlib.contextmanager
def building_for_windows():
    """Let all tools that write FMUs give them a library for Windows only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "library", windows_library)
        patch.setattr(
            fmu_tools,
            "library_name",
            lambda version, identifier="Probe": f"binaries/{FOLDERS[version]}/{identifier}.dll",
        )
        yield


def exchange_fmu(path, model, version, interfaces=("ModelExchange",), flags=""):
    """Write an FMU as ``exchange_tools`` does, with a library for Windows only."""
    with building_for_windows():
        return exchange_tools.exchange_fmu(path, model, version, interfaces, flags)
