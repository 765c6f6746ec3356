"""The C sources compile for every platform without a warning, and without Python."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("ziglang")

NATIVE = Path(__file__).resolve().parent.parent / "native"
CORE = sorted(NATIVE.glob("*.c"))
OPTIONS = ["-std=gnu11", "-O1", "-g0", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
TARGETS = {
    "windows": ["x86_64-windows-gnu"],
    "windows without stdatomic.h": ["x86_64-windows-gnu", "-DFMUGYM_INTERLOCKED"],
    "macos": ["aarch64-macos.11.0"],
    "linux": ["aarch64-linux-gnu"],
    "old linux": ["x86_64-linux-gnu.2.17"],
}


@pytest.mark.parametrize("source", CORE, ids=lambda path: path.stem)
@pytest.mark.parametrize("target", TARGETS)
def test_core_compiles(target, source, tmp_path):
    command = [sys.executable, "-m", "ziglang", "cc", "-target", *TARGETS[target], *OPTIONS]
    command += ["-c", str(source), "-o", str(tmp_path / "object.o")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_core_needs_no_python():
    for path in NATIVE.glob("*.[ch]"):
        assert "Python.h" not in path.read_text(encoding="utf-8")
