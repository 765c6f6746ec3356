"""The C sources compile for every platform without a warning, and without Python."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fmugym.vector.hooks import program

pytest.importorskip("ziglang", reason="needs ziglang: the extra test")

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
        assert not {"Python.h", "numpy/arrayobject.h"} & included(path)


def included(path):
    return set(re.findall(r"#include <(.+)>", path.read_text(encoding="utf-8")))


@pytest.mark.skipif(os.name == "nt", reason="Python's headers are for another compiler there")
@pytest.mark.parametrize("source", sorted(NATIVE.glob("python/*.c")), ids=lambda path: path.stem)
def test_what_presents_it_to_python_compiles(source, tmp_path):
    """Against the stable ABI, and numpy's C interface without what is deprecated."""
    folders = [f"-I{NATIVE}", "-isystem", np.get_include(), f"-I{sysconfig.get_path('include')}"]
    command = [sys.executable, "-m", "ziglang", "cc", *OPTIONS, "-DPy_LIMITED_API=0x030B0000"]
    command += [*folders, "-c", str(source), "-o", str(tmp_path / "object.o")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_no_object_of_others_is_looked_into():
    """The fields of objects are declared for the extension's own types, and for no others."""
    declaring = {p.name for p in NATIVE.glob("**/*.[ch]") if "PyObject_HEAD" in p.read_text()}
    assert declaring == {"python.h"}


def test_the_extension_loads_without_numpy():
    """It imports numpy when the first array is made."""
    from fmugym import _native

    script = f"""
import importlib.util, sys, types
sys.modules["numpy"] = None
for name in ("fmugym", "fmugym.errors"):
    sys.modules[name] = types.ModuleType(name)
sys.modules["fmugym.errors"].SimulationError = RuntimeError
spec = importlib.util.spec_from_file_location("fmugym._native", {_native.__file__!r})
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
print(module.statistics()["jobs"])
"""
    command = [sys.executable, "-S", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "0\n", done.stderr


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
