"""The compiler for what tools build: the system's, or else ziglang."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from typing import Final

from fmugym.errors import ConfigError

__all__ = ["find_compiler"]

_PROGRAMS: Final = ("cc", "gcc", "clang")


def find_compiler(what: str) -> list[str]:
    """The command of a compiler for C.

    Args:
        what: What is to be built, for the error.

    Raises:
        ConfigError: If there is none; the text says how to get one.
    """
    found = next(filter(None, map(shutil.which, _PROGRAMS)), None)
    if found is not None:
        return [found]
    if importlib.util.find_spec("ziglang") is None:
        raise ConfigError(
            f"{what} needs a C compiler: install gcc (Debian: apt install gcc), or ziglang "
            "(pip install ziglang)"
        )
    return [sys.executable, "-m", "ziglang", "cc"]
