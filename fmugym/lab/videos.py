"""Videos of sessions: MP4 if imageio-ffmpeg is installed, otherwise GIF by Pillow."""

from __future__ import annotations

import importlib
import importlib.util
import logging
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError, shown
from fmugym.extras import installation
from fmugym.lab.cell_pictures import CellFrame, CellPicture
from fmugym.lab.data import LabError
from fmugym.signals import ordinary

__all__ = ["FRAME_RATE", "Recording", "VideoFolder"]

logger = logging.getLogger(__name__)

FRAME_RATE: Final = 25
"""Frames per second of the lab's time."""

_SIZE: Final = (320, 320)  # codecs need multiples of 16
_FFMPEG: Final = "imageio_ffmpeg"

Frame = npt.NDArray[np.uint8]


class Recording:
    """The moments of a session, ``FRAME_RATE`` of them per second.

    Attributes:
        moments: The angles of the joints in rad and the torques of the motors in N m, beginning
            with the start of the session.
    """

    def __init__(self) -> None:
        self.moments: list[tuple[Sequence[float], Sequence[float]]] = []

    def observe(self, time: float, position: Sequence[float], torque: Sequence[float]) -> None:
        """Keep this moment if a frame is due.

        Args:
            time: Time of the session, in s.
            position: Angle of each joint, in rad.
            torque: Torque of each motor, in N m.
        """
        if time * FRAME_RATE >= len(self.moments) - 1e-6:
            self.moments.append((position, torque))

    def cut(self, duration: float) -> None:
        """Keep the frames that begin within a duration in s, and at least one frame."""
        frames = -(-round(duration * FRAME_RATE * 1e6) // 1_000_000)
        del self.moments[max(1, frames) :]


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
        _check_can_record()
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
            return _write_video(recording, picture, folder, name).absolute().as_uri()

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


def _check_can_record() -> None:
    if not any(importlib.util.find_spec(name) for name in (_FFMPEG, "PIL")):
        raise LabError(f"recording needs imageio-ffmpeg or Pillow; {installation('lab')}")


def _write_video(recording: Recording, picture: CellPicture, folder: Path, name: str) -> Path:
    """Draw a recording and write it to a file; returns its path."""
    if importlib.util.find_spec(_FFMPEG):
        try:
            return _write_mp4(_frames(recording, picture), folder / f"{name}.mp4")
        except ordinary(OSError, RuntimeError) as error:  # for example no FFmpeg for this platform
            logger.warning("no MP4 can be written (%s); writing a GIF", error)
    return _write_gif(_frames(recording, picture), folder / f"{name}.gif")


def _frames(recording: Recording, picture: CellPicture) -> Iterable[Frame]:
    for index, moment in enumerate(recording.moments):
        yield picture.picture(CellFrame(*moment, index / FRAME_RATE), _SIZE)


def _write_mp4(frames: Iterable[Frame], path: Path) -> Path:
    writer = importlib.import_module(_FFMPEG).write_frames(
        str(path), _SIZE, fps=FRAME_RATE, ffmpeg_log_level="error", output_params=["-threads", "1"]
    )
    try:
        writer.send(None)
        for frame in frames:
            writer.send(frame.tobytes())
    finally:
        writer.close()
    return path


def _write_gif(frames: Iterable[Frame], path: Path) -> Path:
    from PIL import Image

    first, *others = [Image.fromarray(frame).quantize(64) for frame in frames]
    first.save(path, save_all=True, append_images=others, duration=1000 // FRAME_RATE, loop=0)
    return path
