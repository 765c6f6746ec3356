"""Loader of the system, asked for shared libraries.

Run as a program it answers for another process: it reads a list of names as JSON, and prints those
that are missing. It imports nothing but the standard library, so that it starts in 20 ms.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
from collections.abc import Sequence

__all__ = ["ask"]


def ask(names: Sequence[str]) -> list[str]:
    """Ask the loader of this process, which loads what it finds.

    Args:
        names: Names of libraries. A path is not looked for, and not loaded.

    Returns:
        What is missing: libraries of that name, or those that they need.
    """
    return [missing for name in names for missing in _missing(name)]


def _missing(name: str) -> list[str]:
    if "/" in name:
        return [] if os.path.isfile(name) else [name]
    try:
        ctypes.CDLL(name)
    except OSError as error:
        missing, _, reason = str(error).partition(": ")
        return [missing if reason.startswith("cannot open shared object file") else name]
    return []


if __name__ == "__main__":
    answer = ask(json.load(sys.stdin))
    sys.stdout.write(f"\n{json.dumps(answer)}\n")
