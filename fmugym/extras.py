"""Imports on demand: names of packages, and optional libraries of extras; a compiler for C, too."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

from fmugym.errors import ConfigError

__all__ = ["c_compiler", "imported", "installation", "lacking", "lazily"]


def lazily(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Make the ``__getattr__`` of a package (PEP 562).

    Args:
        package: Its name.
        modules: The module of each name; of a module of the package, its own.

    Returns:
        A function that imports a name, keeps it in the package and returns it. It raises an
        ``AttributeError`` for other names.
    """

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(modules[name])
        value = module if modules[name] == f"{package}.{name}" else getattr(module, name)
        setattr(sys.modules[package], name, value)
        return value

    return get


_COMPILERS: Final = ("cc", "gcc", "clang")


def installation(extra: str) -> str:
    """Describe the installation of an extra; ``docs/README.md`` has more."""
    return f"install the extra {extra!r}; in a clone of fmugym: pip install '.[{extra}]'"


def lacking(what: str, library: str, extra: str) -> str:
    """Describe a missing library, and its installation.

    Args:
        what: Name of the feature that needs it.
        library: Its name.
        extra: The extra that installs it.
    """
    return f"{what} needs {library}, which cannot be imported; {installation(extra)}"


def imported(module: str, extra: str) -> Any:
    """Import a library of an extra, or a module of this package that needs one.

    Raises:
        ConfigError: If it is missing.
    """
    try:
        return import_module(module)
    except ImportError as error:
        needed = error.name or module.removeprefix("fmugym.")
        raise ConfigError(lacking("this", needed.partition(".")[0], extra)) from error


def c_compiler(what: str, target: str | None = None, *, is_own: bool = True) -> list[str]:
    """Find the command of a compiler for C: that of this system, or ziglang.

    Args:
        what: Name of the built thing, for the error.
        target: The target triple that ziglang builds for; None for this processor.
        is_own: Whether it is for this platform, so that the compiler of the system serves.

    Raises:
        ConfigError: If there is none; the text says how to get one.
    """
    found = next(filter(None, map(shutil.which, _COMPILERS if is_own else ())), None)
    if found is not None:
        return [found]
    if find_spec("ziglang") is None:
        gcc = "gcc (Debian: apt install gcc), or " if is_own else ""
        raise ConfigError(f"{what} needs a C compiler: install {gcc}ziglang (pip install ziglang)")
    return [sys.executable, "-m", "ziglang", "cc", *(("-target", target) if target else ())]
