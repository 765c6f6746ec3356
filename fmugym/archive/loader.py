"""Asking the system's loader for shared libraries.

Run as a program it answers for another process: it reads a list of names as JSON, and prints those
that are missing. It imports nothing but the standard library, so that it starts in 20 ms.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Sequence

from fmugym.signals import Ignoring, ordinary

__all__ = ["ask", "ask_in_a_child"]

_TIMEOUT = 60.0


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
    except ordinary(OSError) as error:
        missing, _, reason = str(error).partition(": ")
        return [missing if reason.startswith("cannot open shared object file") else name]
    return []


def ask_in_a_child(names: Sequence[str]) -> list[str]:
    """Ask the loader of a child process, so that this one loads nothing; otherwise as ``ask``.

    Where the child dies of a library, or cannot be started, nothing counts as missing.
    """
    if not names:
        return []
    with Ignoring(OSError, ValueError, subprocess.SubprocessError):
        done = subprocess.run(
            [sys.executable, "-I", "-S", __file__],
            input=json.dumps(list(names)).encode(),
            capture_output=True,
            timeout=_TIMEOUT,
            check=True,
        )
        return [str(name) for name in json.loads(done.stdout.splitlines()[-1])]
    return []


if __name__ == "__main__":
    answer = ask(json.load(sys.stdin))
    sys.stdout.write(f"\n{json.dumps(answer)}\n")
