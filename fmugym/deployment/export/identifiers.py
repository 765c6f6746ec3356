"""Names of C for the names of variables, and names of new files."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fmugym.checks import check_path
from fmugym.errors import ConfigError, shown

__all__ = ["identifier", "identifiers", "new_file"]

_WORDS: Final = """
alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl
const constexpr const_cast continue count decltype default delete do double dynamic_cast
else enum explicit export extern false float for friend goto if inline int int64_t long
main mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected
public register reinterpret_cast requires restrict return short signed sizeof static
static_assert static_cast struct switch template this thread_local throw true try typedef
typeid typename union unsigned using virtual void volatile wchar_t while xor xor_eq
"""
"""Words that cannot name a field: keywords of C and C++, and names that the files use."""


def identifier(text: str) -> str:
    """A name of C for a text, such as the name of a variable."""
    text = text.replace("[+", "_in_").replace("[-", "_before_")  # of forecasts and histories
    name = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_") or "x"
    name = f"n{name}" if name[0].isdigit() else name
    return f"{name}_" if name in _WORDS.split() else name


def identifiers(texts: Iterable[str]) -> list[str]:
    """Names of C for some texts, each another one."""
    found: list[str] = []
    for text in texts:
        name, number = identifier(text), 2
        while name in found:
            name, number = f"{identifier(text)}_{number}", number + 1
        found.append(name)
    return found


def new_file(path: str | os.PathLike[str]) -> Path:
    """Check the path of a file to write.

    Raises:
        ConfigError: If it is no path, or its folder does not exist.
        FileExistsError: If the file exists.
    """
    file = check_path("path", path)
    if not file.parent.is_dir():
        raise ConfigError(f"{shown(str(file.parent))} is no folder")
    if file.exists():
        raise FileExistsError(f"{file} exists")
    return file
