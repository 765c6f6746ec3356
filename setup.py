"""The C extension, which is optional: without a compiler the package installs and works without it.

With ``FMUGYM_REQUIRE_NATIVE=1`` in the environment a build that fails is an error. All metadata is
in ``pyproject.toml``.
"""

import os
import sys
import sysconfig
from pathlib import Path

import numpy as np
from setuptools import Extension, setup

if sysconfig.get_config_var("Py_GIL_DISABLED"):
    sys.exit("fmugym needs Python with the GIL: free-threaded Python is not supported")

WINDOWS = sys.platform == "win32"
WISH = os.environ.get("FMUGYM_REQUIRE_NATIVE", "")
if WISH not in ("", "0", "1"):
    sys.exit(f"FMUGYM_REQUIRE_NATIVE must be 0 or 1, not {WISH!r}")
REQUIRED = WISH == "1"

# One wheel for all versions of Python from 3.11 on, the first to have buffers in its stable ABI.
# Results must not depend on the compiler: no contraction, no relaxed floating-point arithmetic.
native = Extension(
    "fmugym._native",
    # native/worker is a program of its own, which fmugym.wine builds where it is needed
    sources=sorted(
        str(path) for folder in (".", "python") for path in Path("native", folder).glob("*.c")
    ),
    depends=sorted(str(path) for path in Path("native").glob("**/*.h")),
    include_dirs=["native", np.get_include()],
    define_macros=[("Py_LIMITED_API", "0x030B0000")],
    extra_compile_args=["/std:c11", "/fp:precise"]
    if WINDOWS
    else [
        *("-std=gnu11", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden"),
        "-Werror=implicit-function-declaration",  # it would fail when it is loaded, without a word
    ],
    libraries=[] if WINDOWS else ["m", "pthread", "dl"],
    py_limited_api=True,
    optional=not REQUIRED,
)

setup(ext_modules=[native], options={"bdist_wheel": {"py_limited_api": "cp311"}})
