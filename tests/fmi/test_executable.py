"""Shared libraries: what their headers give away, what they need, and how it is preloaded."""

import io
import os
import shutil
import subprocess
import sys

import building
import fmpy
import pytest
from combinations import in_turn
from fmu_tools import HERE, edited_fmu, library_name, probe_config, read_fmu

from fmugym import FMU, FMULoadError, bundled_fmu
from fmugym.fmi import fmu as fmus
from fmugym.fmi.binaries import check_library
from fmugym.fmi.library_dependencies import missing_libraries

PENDULUM = read_fmu(bundled_fmu("Pendulum", "3.0"))
FOLDERS = {
    "x86_64-linux": ".so",
    "aarch64-linux": ".so",
    "x86_64-windows": ".dll",
    "x86_64-darwin": ".dylib",
    "aarch64-darwin": ".dylib",
}
each_platform = pytest.mark.parametrize("folder", FOLDERS)
on_linux = pytest.mark.skipif(sys.platform != "linux", reason="asks the loader of Linux")


def library(folder):
    return PENDULUM[f"binaries/{folder}/Pendulum{FOLDERS[folder]}"]


def check(content, suffix, architecture):
    """As a process does that runs on this architecture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fmpy, "architecture", architecture)
        check_library(io.BytesIO(content), len(content), f"some{suffix}")


def refused(content, suffix, architecture, match):
    with pytest.raises(FMULoadError, match=match) as caught:
        check(content, suffix, architecture)
    assert f"some{suffix}" in str(caught.value)


class TestHeaders:
    @each_platform
    def test_sound_libraries(self, folder):
        check(library(folder), FOLDERS[folder], folder.split("-")[0])

    @each_platform
    def test_another_processor(self, folder):
        built_for = folder.split("-")[0]
        match = f"was built for {built_for}, this process runs on riscv64"
        refused(library(folder), FOLDERS[folder], "riscv64", match)

    @each_platform
    def test_another_system(self, folder):
        match = "is a library of (Linux|Windows|macOS).*expected one of"
        for suffix in {*FOLDERS.values()} - {FOLDERS[folder]}:
            refused(library(folder), suffix, "x86_64", match)

    @each_platform
    def test_cut_short_in_the_headers(self, folder):
        cut = library(folder)[:20]
        refused(cut, FOLDERS[folder], folder.split("-")[0], r"is cut short \(20 bytes\)")

    @in_turn({"part": [0.01, 0.2, 0.9], "folder": ["x86_64-linux", "aarch64-linux"]})
    def test_cut_short(self, folder, part):
        """Linux would end the process with SIGBUS; other systems refuse such a library."""
        content = library(folder)
        cut = content[: int(part * len(content))]
        refused(cut, FOLDERS[folder], folder.split("-")[0], "is cut short")

    @in_turn({"suffix": [".so", ".dll", ".dylib"], "content": [b"", b"#!/bin/sh", bytes(1000)]})
    def test_none_at_all(self, suffix, content):
        refused(content, suffix, "x86_64", "is not a shared library")

    @pytest.mark.parametrize(
        ("folder", "place", "value"),
        [("x86_64-linux", 16, 2), ("x86_64-windows", None, 0), ("x86_64-darwin", 12, 2)],
    )
    def test_programs(self, folder, place, value):
        content = bytearray(library(folder))
        if place is None:  # the flags of PE, in its second header
            place = int.from_bytes(content[0x3C:0x40], "little") + 22
        content[place : place + 2] = value.to_bytes(2, "little")
        refused(bytes(content), FOLDERS[folder], "x86_64", "is not a shared library; export")

    def test_universal_libraries_of_macos(self):
        thin = library("x86_64-darwin"), library("aarch64-darwin")
        places = (4096, 4096 + len(thin[0]))
        rows = [
            b"".join(n.to_bytes(4, "big") for n in (machine, 3, place, len(content), 0))
            for machine, place, content in zip((0x01000007, 0x0100000C), places, thin, strict=True)
        ]
        head = b"\xca\xfe\xba\xbe\0\0\0\x02" + b"".join(rows)
        universal = head.ljust(4096, b"\0") + b"".join(thin)
        check(universal, ".dylib", "x86_64")
        check(universal, ".dylib", "aarch64")
        refused(universal, ".dylib", "x86", "built for x86_64 and aarch64")
        refused(universal[:-10], ".dylib", "aarch64", "is cut short")

    @on_linux
    def test_a_library_of_another_processor_in_an_fmu(self, tmp_path):
        """FMI 1.0 and 2.0 have one folder for all processors of 64 bits."""
        other = "aarch64" if fmpy.architecture == "x86_64" else "x86_64"
        add = {library_name(2, "Pendulum"): library(f"{other}-linux")}
        path = edited_fmu(bundled_fmu("Pendulum"), tmp_path, add=add)
        with pytest.raises(FMULoadError, match=f"built for {other}, this process runs on"):
            FMU(path).extract()


@pytest.fixture(scope="module")
def needy(tmp_path_factory):
    """Libraries: libgave.so, and the probe, which needs it and looks for it in ``beside``."""
    folder = tmp_path_factory.mktemp("needy")
    zig = [sys.executable, "-m", "ziglang", "cc", "-shared", "-fPIC", "-O1", "-g0", "-w"]
    (folder / "gave.c").write_text("int gave = 1;")
    command = [*zig, "gave.c", "-o", "libgave.so", "-Wl,-soname,libgave.so"]
    subprocess.run(command, cwd=folder, check=True)
    (folder / "take.c").write_text("extern int gave; int take(void) { return gave; }")
    sources = ["-DFMI_VERSION=2", HERE / "sources/probe.c", "take.c"]
    command = [*zig, *sources, "libgave.so", "-lm", "-Wl,-rpath,$ORIGIN/beside", "-o", "Probe.so"]
    subprocess.run(command, cwd=folder, check=True)
    return folder


@on_linux
class TestMissingLibraries:
    """In processes of their own: a library that was found once stays in a process."""

    @pytest.fixture
    def fmu_path(self, probe, needy, tmp_path):
        return edited_fmu(probe(), tmp_path, add={library_name(2): self.content(needy)})

    @staticmethod
    def content(needy):
        return (needy / "Probe.so").read_bytes()

    @staticmethod
    def run(fmu_path, environment=(), **config):
        """Step the FMU once; returns what came of it."""
        script = f"""
import pathlib, sys
sys.path[:0] = {building.FOLDERS!r}
import fmugym
from fmu_tools import PlainEnv, probe_config
try:
    config = probe_config(**{config!r})
    env = PlainEnv({str(fmu_path)!r}, config)
    env.reset()
    print(env.step([1.0])[0].tolist())
    env.close()
except fmugym.FMULoadError as error:
    print(error)
"""
        command = [sys.executable, "-W", "error", "-c", script]
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, **dict(environment)},
        )
        return done.stdout.strip()

    STEPPED = "[0.10000000149011612, 1.0]"

    def test_are_named(self, fmu_path, temp_root):
        said = self.run(fmu_path)
        assert "Probe.fmu needs shared libraries that are not found here: libgave.so" in said
        assert "name their files in preload=[...]" in said
        assert list(temp_root.iterdir()) == []

    def test_are_preloaded(self, fmu_path, needy):
        preload = [str(needy / "libgave.so")]
        assert self.run(fmu_path, preload=preload) == self.STEPPED

    def test_are_found_as_the_loader_finds_them(self, fmu_path, needy, tmp_path):
        assert self.run(fmu_path, environment={"LD_LIBRARY_PATH": str(needy)}) == self.STEPPED
        beside = library_name(2).replace("Probe.so", "beside/libgave.so")
        add = {beside: (needy / "libgave.so").read_bytes(), library_name(2): self.content(needy)}
        assert self.run(edited_fmu(fmu_path, tmp_path / "other", add=add)) == self.STEPPED

    def test_beside_the_library_where_the_loader_does_not_look(self, fmu_path, needy, tmp_path):
        beside = library_name(2).replace("Probe.so", "libgave.so")
        add = {beside: (needy / "libgave.so").read_bytes()}
        path = edited_fmu(fmu_path, tmp_path / "other", add=add)
        assert FMU(path).runs_here
        assert self.run(path) == self.STEPPED
        assert self.run(path, isolation="process") == self.STEPPED

    def test_those_of_libraries_that_the_fmu_brings(self, needy, tmp_path):
        """The FMU's library is fine, but not the one that it needs."""
        (tmp_path / "beside").mkdir()
        shutil.copy(needy / "Probe.so", tmp_path / "beside" / "libgave.so")
        shutil.copy(needy / "Probe.so", tmp_path)
        assert missing_libraries(tmp_path / "Probe.so") == []  # each finds itself
        (tmp_path / "beside" / "libgave.so").write_bytes(
            self.content(needy).replace(b"libgave.so", b"libtook.so")
        )
        assert missing_libraries(tmp_path / "Probe.so") == ["libtook.so"]

    def test_a_library_that_the_fmu_brings_is_cut_short(self, needy, tmp_path):
        (tmp_path / "beside").mkdir()
        (tmp_path / "beside" / "libgave.so").write_bytes(self.content(needy)[:50])
        shutil.copy(needy / "Probe.so", tmp_path)
        with pytest.raises(FMULoadError, match=r"libgave.so is cut short \(50 bytes\)"):
            missing_libraries(tmp_path / "Probe.so")

    def test_a_preloaded_library_that_is_not_there(self, fmu_path):
        said = self.run(fmu_path, preload=["/nowhere/libgave.so"])
        assert said.startswith("the library '/nowhere/libgave.so' cannot be loaded")


def test_paths_of_preload_are_relative_to_the_class(probe, tmp_path, monkeypatch):
    (tmp_path / "preloading_tank.py").write_text(
        "import fmugym\n"
        "class Tank(fmugym.FMI2CSEnv):\n"
        "    def __init__(self, path, config):\n"
        "        super().__init__(path, config)\n"
        "    def _is_done(self):\n"
        "        return False\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    from preloading_tank import Tank

    loaded = []
    monkeypatch.setattr(fmus, "load_globally", loaded.append)
    config = probe_config(preload=["lib/libgave.so", "libm.so.6"])
    Tank(probe(), config).close()
    assert loaded == [str(tmp_path / "lib" / "libgave.so"), "libm.so.6"]
    monkeypatch.chdir(tmp_path)
    assert FMU(probe(), preload=["lib/a.so"]).preload == (str(tmp_path / "lib" / "a.so"),)
