"""Standard streams of the command line, which FMUs and their libraries must not write to."""

from __future__ import annotations

import ctypes
import io
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

__all__ = ["drop_output", "escape_what_consoles_lack", "keep_output_from_fmus", "named"]


def keep_output_from_fmus(*, shown: bool) -> BinaryIO | None:
    """Keep the standard streams for Python's output; all other output goes elsewhere.

    FMUs print what they like. A table, or the JSON that another program reads, must not have it
    between its lines. The C library writes what it still has when the process ends, so this is not
    undone.

    Args:
        shown: Whether it goes to the standard error instead of a file.

    Returns:
        The file, which has no name, so that nothing is left of it after any end of the process.
    """
    with suppress(OSError, AttributeError, io.UnsupportedOperation):
        if (sys.stdout.fileno(), sys.stderr.fileno()) != (1, 2):
            return None
        sys.stdout = _apart(sys.stdout)
        if shown:
            os.dup2(2, 1)
            return None
        sys.stderr = _apart(sys.stderr)
        file = tempfile.TemporaryFile()  # noqa: SIM115, it lives as long as the process
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        return file
    return None


def _apart(stream: Any) -> Any:
    """The same stream on a descriptor of its own."""
    stream.flush()
    return open(
        os.dup(stream.fileno()),
        "w",
        encoding=stream.encoding,
        errors=stream.errors,
        buffering=1 if stream.line_buffering or stream.write_through else -1,
    )


def named(printed: BinaryIO) -> Path | None:
    """Give a name to the file with the output of FMUs; None if there is no output."""
    with suppress(OSError, AttributeError, TypeError):  # Windows has no such library
        ctypes.CDLL(None).fflush(None)
    if not printed.seek(0, os.SEEK_END):
        return None
    printed.seek(0)
    with tempfile.NamedTemporaryFile(prefix="fmugym-printed-", suffix=".txt", delete=False) as file:
        shutil.copyfileobj(printed, file)
    return Path(file.name)


def escape_what_consoles_lack() -> None:
    """Names and descriptions of an FMU may have letters that an old console cannot show."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def drop_output() -> None:
    """Discard buffered output, about which the interpreter would complain at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
