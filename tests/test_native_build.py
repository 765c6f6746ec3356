"""The C sources compile for every platform without a warning, and without Python."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from fmugym.pool import has_native_pool
from fmugym.vector.hooks import program

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


def build_without_compiler(folder, **environment):
    """Build the extension with a compiler that fails."""
    for name in ("setup.py", "native"):
        (shutil.copy if name.endswith(".py") else shutil.copytree)(
            NATIVE.parent / name, folder / name
        )
    return subprocess.run(
        [sys.executable, "setup.py", "-q", "build_ext", "--build-lib", "lib", "--build-temp", "t"],
        cwd=folder,
        env=os.environ | {"CC": "false", "FMUGYM_REQUIRE_NATIVE": "0"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.skipif(os.name != "posix", reason="the compiler of Windows is not chosen by CC")
def test_a_build_that_fails_is_an_error_only_where_it_is_required(tmp_path):
    for folder in ("optional", "required"):
        (tmp_path / folder).mkdir()
    assert build_without_compiler(tmp_path / "optional").returncode == 0
    assert build_without_compiler(tmp_path / "required", FMUGYM_REQUIRE_NATIVE="1").returncode != 0


def test_free_threaded_python_is_refused(tmp_path):
    script = "import sysconfig, runpy\n"
    script += "sysconfig.get_config_vars()['Py_GIL_DISABLED'] = 1\n"
    script += f"runpy.run_path({str(NATIVE.parent / 'setup.py')!r})"
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "free-threaded Python is not supported" in done.stderr


@pytest.mark.skipif(not has_native_pool(), reason="no C extension was built")
def test_the_table_of_operations_is_that_of_the_extension():
    from fmugym import _native

    program.require_same_table(_native)
    assert _native.operations() == program.OPERATIONS


@pytest.mark.parametrize(
    "stale",
    [
        SimpleNamespace(),
        SimpleNamespace(operations=lambda: program.OPERATIONS, MOST_REGISTERS=64),
        SimpleNamespace(operations=lambda: program.OPERATIONS[:-1], MOST_REGISTERS=256),
        SimpleNamespace(operations=lambda: program.OPERATIONS[::-1], MOST_REGISTERS=256),
    ],
)
def test_a_stale_extension_is_refused_with_the_cure(stale):
    with pytest.raises(ImportError, match="pip install"):
        program.require_same_table(stale)
