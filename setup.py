"""The C extension, which is optional: without a compiler the package installs and works without it.

All metadata is in ``pyproject.toml``.
"""

import sys
from pathlib import Path

from setuptools import Extension, setup

WINDOWS = sys.platform == "win32"

# One wheel for all versions of Python from 3.11 on, the first to have buffers in its stable ABI.
# Results must not depend on the compiler: no contraction, no relaxed floating-point arithmetic.
native = Extension(
    "fmugym._native",
    sources=sorted(str(path) for path in Path("native").glob("**/*.c")),
    depends=sorted(str(path) for path in Path("native").glob("**/*.h")),
    include_dirs=["native"],
    define_macros=[("Py_LIMITED_API", "0x030B0000")],
    extra_compile_args=["/std:c11", "/fp:precise"]
    if WINDOWS
    else ["-std=gnu11", "-O3", "-ffp-contract=off", "-fvisibility=hidden"],
    libraries=[] if WINDOWS else ["m", "pthread", "dl"],
    py_limited_api=True,
    optional=True,
)

setup(ext_modules=[native], options={"bdist_wheel": {"py_limited_api": "cp311"}})
