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
from process_tools import run_python
from setuptools import Extension

import build_backend
from fmugym.expressions import program

pytest.importorskip("ziglang", reason="needs ziglang: the extra test")

ROOT = Path(__file__).resolve().parents[2]
NATIVE = ROOT / "native"
CORE = sorted(p for p in NATIVE.glob("*/*.c") if p.parent.name not in {"python", "worker"})
OPTIONS = ["-std=gnu11", "-O1", "-g0", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
TARGETS = {
    "windows": ["x86_64-windows-gnu"],
    "windows without stdatomic.h": ["x86_64-windows-gnu", "-DFMUGYM_INTERLOCKED"],
    "macos": ["aarch64-macos.11.0"],
    "linux": ["aarch64-linux-gnu"],
    "old linux": ["x86_64-linux-gnu.2.17"],
}


def require_compiled(command, sources, folder):
    """Each for itself: zig cannot make one object of many for Windows."""
    for source in sources:
        given = [*command, "-c", str(source), "-o", str(folder / "object.o")]
        done = subprocess.run(given, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("target", TARGETS)
def test_core_compiles(target, tmp_path):
    command = [sys.executable, "-m", "ziglang", "cc", "-target", *TARGETS[target], *OPTIONS]
    require_compiled([*command, f"-I{NATIVE}"], CORE, tmp_path)


def test_core_needs_no_python():
    for path in NATIVE.glob("*/*.[ch]"):
        if path.parent.name != "python":
            assert not {"Python.h", "numpy/arrayobject.h"} & included(path)


def included(path):
    return set(re.findall(r"#include <(.+)>", path.read_text(encoding="utf-8")))


@pytest.mark.skipif(os.name == "nt", reason="Python's headers are for another compiler there")
def test_what_presents_it_to_python_compiles(tmp_path):
    """Against the stable ABI, and numpy's C interface without what is deprecated."""
    folders = [f"-I{NATIVE}", "-isystem", np.get_include(), f"-I{sysconfig.get_path('include')}"]
    command = [sys.executable, "-m", "ziglang", "cc", *OPTIONS, "-DPy_LIMITED_API=0x030B0000"]
    require_compiled([*command, *folders], NATIVE.glob("python/*.c"), tmp_path)


def test_no_object_of_others_is_looked_into():
    """The fields of objects are declared for the extension's own types, and for no others."""
    declaring = {p.name for p in NATIVE.glob("**/*.[ch]") if "PyObject_HEAD" in p.read_text()}
    assert declaring == {"python.h"}


def test_a_bare_interpreter_loads_the_extension():
    """It imports nothing of the package, and numpy when the first array is made."""
    from fmugym import _native

    script = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("fmugym._native", {_native.__file__!r})
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
print(module.statistics()["jobs"])
loaded = {{name.partition(".")[0] for name in sys.modules.keys() - {{"fmugym._native"}}}}
print(loaded & {{"fmugym", "numpy"}})
"""
    command = [sys.executable, "-I", "-S", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "0\nset()\n", done.stderr


def test_a_build_that_fails_is_an_error(tmp_path):
    for name in ("build_backend.py", "setup.py"):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(NATIVE, tmp_path / "native")
    (tmp_path / "native/fmi/access.c").write_text("#error broken\n", encoding="utf-8")
    command = [sys.executable, "setup.py", "-q", "build_ext", "--build-lib", "lib"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "broken" in done.stderr


@pytest.mark.skipif(os.name == "nt", reason="Python's headers are for another compiler there")
@pytest.mark.parametrize("target", ["x86_64-macos.10.13", "aarch64-macos.11.0"])
def test_zig_builds_the_extension_for_macos_in_one_command(target, tmp_path):
    """With this system's headers of Python and numpy, and what numpy's ask of it."""
    order = "#define __LITTLE_ENDIAN 1234\n#define __BIG_ENDIAN 4321\n#define __BYTE_ORDER 1234\n"
    (tmp_path / "endian.h").write_text(order, encoding="utf-8")
    sources = [str(path) for path in (*CORE, *NATIVE.glob("python/*.c"))]
    folders = [str(NATIVE), np.get_include(), str(tmp_path)]
    options = build_backend.OPTIONS
    extension = Extension("fmugym._native", sources, include_dirs=folders, **options)
    command = build_backend.zig_command(target, extension, tmp_path / "_native.so")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert b"PyInit__native" in (tmp_path / "_native.so").read_bytes()


def test_free_threaded_python_is_refused():
    script = "import sysconfig, runpy\n"
    script += "sysconfig.get_config_vars()['Py_GIL_DISABLED'] = 1\n"
    script += "runpy.run_path('setup.py')"
    done = run_python("-c", script, cwd=ROOT)
    assert done.returncode != 0
    assert "free-threaded Python is not supported" in done.stderr


def test_the_table_of_operations_is_that_of_the_extension():
    from fmugym import _native

    program.require_same_table(_native)
    assert _native.OPERATIONS == program.OPERATIONS


@pytest.mark.parametrize(
    "stale",
    [
        SimpleNamespace(),
        SimpleNamespace(OPERATIONS=program.OPERATIONS, MOST_REGISTERS=64),
        SimpleNamespace(OPERATIONS=program.OPERATIONS[:-1], MOST_REGISTERS=256),
        SimpleNamespace(OPERATIONS=program.OPERATIONS[::-1], MOST_REGISTERS=256),
    ],
)
def test_a_stale_extension_is_refused_with_the_cure(stale):
    with pytest.raises(ImportError, match="pip install"):
        program.require_same_table(stale)
