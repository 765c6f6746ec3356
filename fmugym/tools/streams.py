"""The standard output of the command line, which FMUs and their libraries must not write to."""

from __future__ import annotations

import io
import os
import sys

from fmugym.signals import Ignoring

__all__ = ["drop_output", "escape_what_consoles_lack", "keep_output_from_fmus"]


def keep_output_from_fmus() -> None:
    """Let the standard output have what Python prints; all else goes to the standard error.

    FMUs print what they like. A table, or the JSON that another program reads, must not have it
    between its lines. The C library writes what it still has when the process ends, so this is not
    undone.
    """
    old = sys.stdout
    with Ignoring(OSError, AttributeError, io.UnsupportedOperation):
        if old.fileno() != 1 or not isinstance(old, io.TextIOWrapper):
            return
        old.flush()
        own = os.dup(1)
        os.dup2(sys.stderr.fileno(), 1)
        sys.stdout = open(  # noqa: SIM115, it lives as long as the process
            own,
            "w",
            encoding=old.encoding,
            errors=old.errors,
            buffering=1 if old.line_buffering else -1,
        )


def escape_what_consoles_lack() -> None:
    """Names and descriptions of an FMU may have letters that an old console cannot show."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def drop_output() -> None:
    """Discard what is still buffered, which the interpreter would complain about at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
