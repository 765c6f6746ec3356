"""Videos of sessions: an MP4 by FFmpeg where imageio-ffmpeg is installed, else a GIF by Pillow."""

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

from fmugym.lab.errors import LabError
from fmugym.lab.pictures import CellPicture

__all__ = ["FRAME_RATE", "Moment", "Recording", "check_can_record", "write_video"]

logger = logging.getLogger(__name__)

FRAME_RATE: Final = 25
"""Frames a second of the lab's time."""

_SIZE: Final = (320, 320)  # codecs want multiples of 16
_FFMPEG: Final = "imageio_ffmpeg"
_HOW_TO: Final = "install one with: pip install 'fmugym-toolbox[lab]'"

Frame = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Moment:
    """What a frame shows.

    Attributes:
        position: Angle of each joint, in rad.
        torque: Of each motor, in N m.
    """

    position: Sequence[float]
    torque: Sequence[float]


class Recording:
    """The moments of a session, ``FRAME_RATE`` of them a second.

    Attributes:
        moments: From the session's start on.
    """

    def __init__(self) -> None:
        self.moments: list[Moment] = []

    def observe(self, time: float, position: Sequence[float], torque: Sequence[float]) -> None:
        """Keep this moment if a frame is due.

        Args:
            time: Time of the session, in s.
            position: Angle of each joint, in rad.
            torque: Of each motor, in N m.
        """
        if time * FRAME_RATE >= len(self.moments) - 1e-6:
            self.moments.append(Moment(position, torque))

    def cut(self, duration: float) -> None:
        """Keep the frames that begin before the session's end, and at least one."""
        frames = -(-round(duration * FRAME_RATE * 1e6) // 1_000_000)
        del self.moments[max(1, frames) :]


def check_can_record() -> None:
    """Find out whether a video could be written.

    Raises:
        LabError: If neither imageio-ffmpeg nor Pillow is installed.
    """
    if not any(importlib.util.find_spec(name) for name in (_FFMPEG, "PIL")):
        raise LabError(f"recording needs imageio-ffmpeg or Pillow; {_HOW_TO}")


def write_video(recording: Recording, picture: CellPicture, folder: Path, name: str) -> Path:
    """Draw a recording and write it to a file.

    Args:
        recording: What to draw.
        picture: How to draw it.
        folder: Where to; made if it is not there.
        name: The file's name without its suffix.

    Returns:
        The path of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if importlib.util.find_spec(_FFMPEG):
        try:
            return _write_mp4(_frames(recording, picture), folder / f"{name}.mp4")
        except (OSError, RuntimeError) as error:  # there is no FFmpeg for this platform
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
