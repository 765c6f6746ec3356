"""Compile the libraries of test FMUs, each once for all processes of a test run."""

import contextlib
import functools
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import fmpy

HERE = Path(__file__).parents[1]
_BENCHMARKS = HERE.parent / "benchmarks"
FOLDERS = sorted(
    {str(HERE), str(_BENCHMARKS), *(str(path.parent) for path in HERE.rglob("test_*.py"))}
)
"""Where tests are: they import helpers and each other by the names of their modules."""

PATH = os.pathsep.join(FOLDERS)
"""The same as the value of ``PYTHONPATH``."""

FOLDER = "FMUGYM_TESTS_FOLDER"
"""The environment variable with the folder that the processes of a test run share."""

FLAGS = ("-shared", "-fPIC", "-O1", "-g0", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror")
FLAGS += ("-Wno-unused-parameter", "-Wno-unused-result")


@functools.cache
def compiler():
    """The command of a C compiler: the system's, which is faster, or else zig's."""
    return ["cc"] if shutil.which("cc") else [sys.executable, "-m", "ziglang", "cc"]


@functools.cache
def library(*sources, flags=(), stubs=None):
    """The bytes of a shared library; the first call takes a few tenths of a second.

    Args:
        sources: The C files, relative to ``HERE``.
        flags: More arguments of the compiler.
        stubs: The text of the file that the sources include as ``STUBS``.
    """
    key = sources, flags, stubs
    command = [*compiler(), *FLAGS, "-pthread"]
    return once(key, fmpy.sharedLibraryExtension, lambda path: compile_to(path, command, *key))


def once(key, suffix, build):
    """The bytes of a file that one process of a test run builds, and the others find.

    Args:
        key: What the file depends on.
        suffix: That of its name.
        build: Writes it to a path.
    """
    digest = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
    with contextlib.ExitStack() as stack:
        folder = os.environ.get(FOLDER) or stack.enter_context(tempfile.TemporaryDirectory())
        path = Path(folder) / f"{digest}{suffix}"
        if not path.exists():
            build(path)
        return path.read_bytes()


def compile_to(path, command, sources, flags, stubs):
    """Compile elsewhere and move the result, for another process may do the same.

    The name that a library for Windows is compiled under becomes a part of it.
    """
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        (Path(folder) / "stubs.h").write_text(stubs or "")
        files = [HERE / source for source in sources]
        own = ["-I.", '-DSTUBS="stubs.h"', *flags, *files, "-o", "made", "-lm"]
        subprocess.run([*command, *own], check=True, cwd=folder)
        (Path(folder) / "made").replace(path)
