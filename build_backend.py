"""The build backend: setuptools, and zig as its compiler where the system has none.

pip calls the functions of PEP 517 and PEP 660; ``setup.py`` builds with ``BuildExtension``.
"""

import functools
import os
import platform
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from setuptools import Distribution, Extension, build_meta
from setuptools.build_meta import *  # noqa: F403  (the functions that are not below)
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError

# Results must not depend on the compiler: no contraction, no relaxed floating-point arithmetic.
_FLAGS = [
    *("-std=gnu11", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden"),
    "-Werror=implicit-function-declaration",  # it would fail when it is loaded, without a word
]
_IS_WINDOWS = sys.platform == "win32"
# One wheel for all versions of Python from 3.11 on, the first to have buffers in its stable ABI.
OPTIONS = {
    "define_macros": [("Py_LIMITED_API", "0x030B0000")],
    "extra_compile_args": ["/std:c11", "/fp:precise"] if _IS_WINDOWS else _FLAGS,
    "libraries": [] if _IS_WINDOWS else ["m", "pthread", "dl"],
    "py_limited_api": True,
}
# Without -mcpu zig would build for this machine's processor only.
_ZIG = [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"]
_TARGETS = {
    ("win32", "AMD64"): "x86_64-windows-gnu",
    ("darwin", "x86_64"): "x86_64-macos.10.13",
    ("darwin", "arm64"): "aarch64-macos.11.0",
}
_PROBE = "#include <Python.h>\nPyMODINIT_FUNC PyInit_probe(void) { return NULL; }\n"


def get_requires_for_build_wheel(config_settings=None):
    """What a build takes: zig, too, where there is no compiler."""
    return [*build_meta.get_requires_for_build_wheel(config_settings), *_compiler()]


def get_requires_for_build_editable(config_settings=None):
    """What an editable build takes: zig, too, where there is no compiler."""
    return [*build_meta.get_requires_for_build_editable(config_settings), *_compiler()]


def _compiler():
    return ["ziglang>=0.13"] if has_headers() and not _system_compiles() else []


def has_headers():
    """Whether the headers of Python are here, without which nothing compiles."""
    return Path(sysconfig.get_path("include"), "Python.h").is_file()


@functools.cache
def _system_compiles():
    """Whether setuptools finds a compiler, and that one all that it needs."""
    with tempfile.TemporaryDirectory(prefix="fmugym-build-") as folder:
        source = Path(folder, "probe.c")
        source.write_text(_PROBE, encoding="utf-8")
        probe = Extension("probe", [str(source)], **OPTIONS)
        command = build_ext(Distribution({"ext_modules": [probe]}))
        command.build_lib = command.build_temp = folder
        command.ensure_finalized()
        try:
            command.run()
        except (BaseError, CCompilerError, SystemError):  # the last one on macOS
            return False
    return True


class BuildExtension(build_ext):
    """Builds with the system's compiler, or else with zig."""

    def run(self):
        """Build; on Linux, zig is a compiler like any other."""
        if not _system_compiles():
            os.environ |= {"CC": shlex.join(_ZIG), "LDSHARED": shlex.join([*_ZIG, "-shared"])}
        super().run()

    def build_extension(self, extension):
        """Build by one command of zig where setuptools has no place for it."""
        target = _TARGETS.get((sys.platform, platform.machine()))
        if target is None or _system_compiles():
            super().build_extension(extension)
            return
        library = Path(self.get_ext_fullpath(extension.name))
        made = Path(self.build_temp, library.name)  # beside it, zig writes what no wheel needs
        for path in (made, library):
            path.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(zig_command(target, extension, made), check=True)
        self.copy_file(made, library)


def zig_command(target, extension, library):
    """The command that builds the extension for Windows or macOS.

    Args:
        target: zig's target triple.
        extension: What setuptools knows of it.
        library: The new file.
    """
    python = ["-undefined", "dynamic_lookup"]
    if "windows" in target:  # Python 3.11 defines MS_WIN64 for the compiler of Microsoft only
        python = ["-DMS_WIN64=", str(Path(sys.base_prefix, "libs", "python3.lib"))]
    folders = [*extension.include_dirs, sysconfig.get_path("include")]
    return [
        *(*_ZIG, "-target", target, *_FLAGS, "-g0", "-shared", "-o", str(library)),
        *(f"-D{name}={value}" for name, value in extension.define_macros),
        *(f"-I{folder}" for folder in folders),
        *(*extension.sources, *python),
    ]
