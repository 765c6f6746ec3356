"""The folder of a lab's videos."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fmugym.errors import ConfigError, shown
from fmugym.lab.cell_pictures import CellPicture
from fmugym.lab.lab_error import LabError
from fmugym.lab.video_files import Recording, check_can_record, write_video
from fmugym.signals import ordinary

__all__ = ["VideoFolder"]


class VideoFolder:
    """A folder for videos, created when the first recording is requested.

    Args:
        path: The folder; None for a temporary one, which `close` removes.

    Raises:
        ConfigError: If the path is not a text or a path, or names an existing file.
    """

    def __init__(self, path: str | Path | None) -> None:
        self._path = None if path is None else _checked(path)
        self._remove: weakref.finalize[..., VideoFolder] | None = None

    def prepare(self) -> Path:
        """Check that videos can be written, and return the folder.

        Raises:
            LabError: If a package is missing, or the folder cannot be created or written to.
        """
        check_can_record()
        with _named_failure(self._path):
            if self._path is None:
                self._path = Path(tempfile.mkdtemp(prefix="fmugym-lab-"))
                self._remove = weakref.finalize(self, shutil.rmtree, self._path, ignore_errors=True)
            self._path.mkdir(parents=True, exist_ok=True)
            if not os.access(self._path, os.W_OK | os.X_OK):
                raise PermissionError("no permission to write")
            return self._path

    def write(self, recording: Recording, picture: CellPicture, name: str) -> str:
        """Write a video.

        Args:
            recording: The moments to draw.
            picture: Draws the cell.
            name: The name of the file without its suffix.

        Returns:
            The address of the file.

        Raises:
            LabError: If the file cannot be written.
        """
        folder = self.prepare()
        with _named_failure(folder):
            return write_video(recording, picture, folder, name).absolute().as_uri()

    def close(self) -> None:
        """Remove a temporary folder; a second call does nothing."""
        if self._remove is not None:
            self._remove()


@contextmanager
def _named_failure(path: Path | None) -> Iterator[None]:
    try:
        yield
    except ordinary(OSError, ValueError) as error:  # ValueError: a character that paths cannot have
        where = "the temporary folder" if path is None else shown(str(path))
        raise LabError(f"no video can be written to {where}: {shown(str(error))}") from error


def _checked(path: Any) -> Path:
    if not isinstance(path, str | Path) or not str(path) or "\0" in str(path):
        raise ConfigError(f"video_folder must be a path, not {shown(path)}")
    if os.path.lexists(path) and not os.path.isdir(path):
        raise ConfigError(f"video_folder must be a folder, but {shown(str(path))} is a file")
    return Path(path)
