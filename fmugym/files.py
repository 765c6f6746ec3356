"""Replacement of files: older ones stay until the new ones are complete."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["replaced", "replaced_together", "write_whole"]


@contextmanager
def replaced_together() -> Iterator[Callable[[Path], Path]]:
    """Replace files together: if one cannot be written, all old ones stay.

    ::

        with replaced_together() as beside:
            model.save(beside(folder / "model.zip"))
            beside(folder / "facts.json").write_text(facts)

    Yields:
        A function that tells for the path of a file where to write it first: a path with the same
        ending. At the end of the block the new files take their places, in the order of its calls.
    """
    parts: dict[Path, Path] = {}

    def beside(path: Path) -> Path:
        path = path.resolve()  # a link stays one
        part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
        parts[part] = path
        return part

    try:
        yield beside
        for part in parts:
            _sync(part)
        for part, path in parts.items():
            part.replace(path)
    finally:
        for part in parts:
            part.unlink(missing_ok=True)


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Replace one file.

    Args:
        path: Path of the file.

    Yields:
        Where to write it first.
    """
    with replaced_together() as beside:
        yield beside(path)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file; the one before stays until this one is complete."""
    with replaced(path) as part:
        part.write_bytes(content)


def _sync(path: Path) -> None:
    """Wait until the system has written a file: some systems tell only then that a disk is full."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())
