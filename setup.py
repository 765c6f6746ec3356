"""The C extension: all metadata is in ``pyproject.toml``, its compiler in ``build_backend.py``.

Where the headers of Python are missing, the package is installed without it.
"""

import sys
import sysconfig
from pathlib import Path

import numpy as np
from setuptools import Extension, setup

from build_backend import OPTIONS, BuildExtension, has_headers

if sysconfig.get_config_var("Py_GIL_DISABLED"):
    sys.exit("fmugym needs Python with the GIL: free-threaded Python is not supported")

native = Extension(
    "fmugym._native",
    sources=sorted(
        str(path)
        for path in Path("native").glob("*/*.c")
        if path.name != "main.c"  # of the worker program, which fmugym.fmi.wine builds
    ),
    depends=sorted(str(path) for path in Path("native").glob("**/*.h")),
    include_dirs=["native", np.get_include()],
    **OPTIONS,
)

setup(
    ext_modules=[native] if has_headers() else [],
    cmdclass={"build_ext": BuildExtension},
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
