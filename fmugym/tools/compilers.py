"""The compiler for what tools build: the system's, or else ziglang."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from typing import Final

from fmugym.errors import ConfigError

__all__ = ["find_compiler"]

_PROGRAMS: Final = {"C": ("cc", "gcc", "clang"), "C++": ("c++", "g++", "clang++")}
_ZIG: Final = {"C": "cc", "C++": "c++"}


def find_compiler(what: str, language: str = "C") -> list[str]:
    """The command of a compiler.

    Args:
        what: What is to be built, for the error.
        language: C or C++.

    Raises:
        ConfigError: If there is none; the text says how to get one.
    """
    found = next(filter(None, map(shutil.which, _PROGRAMS[language])), None)
    if found is not None:
        return [found]
    if importlib.util.find_spec("ziglang") is None:
        raise ConfigError(
            f"{what} needs a {language} compiler: install gcc (Debian: apt install gcc g++), or "
            "ziglang (pip install ziglang)"
        )
    return [sys.executable, "-m", "ziglang", _ZIG[language]]
