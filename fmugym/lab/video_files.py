"""Videos of sessions: MP4 if imageio-ffmpeg is installed, otherwise GIF by Pillow."""

from __future__ import annotations

import importlib
import importlib.util
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from fmugym.extras import installation
from fmugym.lab.cell_pictures import CellPicture
from fmugym.lab.lab_error import LabError
from fmugym.signals import ordinary

__all__ = ["FRAME_RATE", "Moment", "Recording", "check_can_record", "write_video"]

logger = logging.getLogger(__name__)

FRAME_RATE: Final = 25
"""Frames per second of the lab's time."""

_SIZE: Final = (320, 320)  # codecs need multiples of 16
_FFMPEG: Final = "imageio_ffmpeg"

Frame = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Moment:
    """The content of a frame.

    Attributes:
        position: Angle of each joint, in rad.
        torque: Torque of each motor, in N m.
    """

    position: Sequence[float]
    torque: Sequence[float]


class Recording:
    """The moments of a session, ``FRAME_RATE`` of them per second.

    Attributes:
        moments: The moments, beginning with the start of the session.
    """

    def __init__(self) -> None:
        self.moments: list[Moment] = []

    def observe(self, time: float, position: Sequence[float], torque: Sequence[float]) -> None:
        """Keep this moment if a frame is due.

        Args:
            time: Time of the session, in s.
            position: Angle of each joint, in rad.
            torque: Torque of each motor, in N m.
        """
        if time * FRAME_RATE >= len(self.moments) - 1e-6:
            self.moments.append(Moment(position, torque))

    def cut(self, duration: float) -> None:
        """Keep the frames that begin within a duration in s, and at least one frame."""
        frames = -(-round(duration * FRAME_RATE * 1e6) // 1_000_000)
        del self.moments[max(1, frames) :]


def check_can_record() -> None:
    """Check that the packages for videos are installed.

    Raises:
        LabError: If neither imageio-ffmpeg nor Pillow is installed.
    """
    if not any(importlib.util.find_spec(name) for name in (_FFMPEG, "PIL")):
        raise LabError(f"recording needs imageio-ffmpeg or Pillow; {installation('lab')}")


def write_video(recording: Recording, picture: CellPicture, folder: Path, name: str) -> Path:
    """Draw a recording and write it to a file.

    Args:
        recording: The moments to draw.
        picture: Draws the cell.
        folder: The folder of the file, which must exist.
        name: The name of the file without its suffix.

    Returns:
        The path of the file.

    Raises:
        OSError: If the file cannot be written.
    """
    if importlib.util.find_spec(_FFMPEG):
        try:
            return _write_mp4(_frames(recording, picture), folder / f"{name}.mp4")
        except ordinary(OSError, RuntimeError) as error:  # for example no FFmpeg for this platform
            logger.warning("no MP4 can be written (%s); writing a GIF", error)
    return _write_gif(_frames(recording, picture), folder / f"{name}.gif")


def _frames(recording: Recording, picture: CellPicture) -> Iterable[Frame]:
    for index, moment in enumerate(recording.moments):
        yield picture.draw(moment.position, moment.torque, index / FRAME_RATE, _SIZE)


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
