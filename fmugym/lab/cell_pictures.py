"""Pictures of one cell or of several cells side by side."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.lab.data import CellType
from fmugym.rendering import (
    Canvas,
    PendulumFrame,
    PendulumScene,
    Point,
    Renderer,
    World,
    palette,
)
from fmugym.rendering._pygame import pygame
from fmugym.rendering.canvas import direction
from fmugym.rendering.window import Window

__all__ = ["CellFrame", "CellPicture", "LiveView"]

_THICKNESS: Final = 0.09  # of a link, in lengths of the arm
_SCALE: Final = 0.15  # N m, for arrows where the torque limit is 0 or infinite

_SIZE: Final = (240, 240)  # of each cell in a live view, in pixels

_drawing = threading.Lock()
"""Only one thread may draw at a time, as pygame's fonts are not thread-safe."""


class CellFrame(NamedTuple):
    """One moment of a cell.

    Attributes:
        position: Angle of each joint, in rad, 0 hanging; the elbow's is relative to the first
            link.
        torque: Torque of each motor, in N m, counter-clockwise positive.
        time: Time of the session, in s.
    """

    position: Sequence[float]
    torque: Sequence[float]
    time: float


class CellPicture:
    """Draws one cell with a caption: a pendulum, or two links with the torques at their joints.

    Args:
        cell_id: The cell's number, for the caption.
        cell_type: The cell's type.
        torque_limit: The torque whose arrow sweeps 150 degrees, in N m; if it is 0 or infinite,
            0.15 N m takes its place.
    """

    world = World(-1.5, -1.4, 1.5, 1.75)

    def __init__(self, cell_id: int, cell_type: CellType, torque_limit: float) -> None:
        self._cell_id, self._cell_type = cell_id, cell_type
        self._torque_limit = torque_limit if 0.0 < torque_limit < math.inf else _SCALE
        self._renderer: Renderer[CellFrame] | None = None

    def picture(self, frame: CellFrame, size: tuple[int, int]) -> npt.NDArray[np.uint8]:
        """Draw one moment.

        Args:
            frame: The moment.
            size: Width and height of the picture, in pixels.

        Returns:
            An array of shape (height, width, 3).
        """
        with _drawing:
            if self._renderer is None or self._renderer.size != size:
                self._renderer = Renderer(self, size)
            picture = self._renderer.render(frame)
        assert picture is not None
        return picture

    def draw(self, canvas: Canvas, frame: CellFrame) -> None:
        """Draw the arm, and the caption in the upper left corner."""
        if self._cell_type is CellType.SINGLE:
            pendulum = PendulumFrame(frame.position[0] - math.pi, frame.torque[0])
            PendulumScene(self._torque_limit).draw(canvas, pendulum)
        else:
            self._draw_links(canvas, frame)
        height, caption = canvas.size[1], f"cell {self._cell_id}   {frame.time:.2f} s"
        canvas.caption((height // 20, height // 20), caption, height // 12, palette.MUTED)

    def _draw_links(self, canvas: Canvas, frame: CellFrame) -> None:
        """Draw the circle of the tip, the torques and the links."""
        canvas.ring((0.0, 0.0), 1.0, 0.014, palette.FAINT)
        start: Point = (0.0, 0.0)
        angle = -math.pi / 2
        for q, torque in zip(frame.position, frame.torque, strict=True):
            angle += q
            self._draw_torque(canvas, start, angle, torque)
            start = _draw_link(canvas, start, angle)

    def _draw_torque(self, canvas: Canvas, joint: Point, angle: float, torque: float) -> None:
        sweep = math.radians(150.0) * min(max(torque / self._torque_limit, -1.0), 1.0)
        begin = angle + math.copysign(0.15, torque)
        canvas.arc_arrow(joint, 0.3, begin, sweep, 0.06, palette.ACCENT)


def _draw_link(canvas: Canvas, joint: Point, angle: float) -> Point:
    along = direction(angle)
    tip = (joint[0] + 0.5 * along[0], joint[1] + 0.5 * along[1])
    canvas.line(joint, tip, _THICKNESS, palette.STEEL)
    canvas.circle(joint, 0.09, palette.INK)
    canvas.circle(tip, 0.09, palette.INK)
    return tip


class LiveView:
    """The cells of a lease side by side, as arrays or in a window.

    Args:
        pictures: The picture of each cell, from left to right.
    """

    def __init__(self, pictures: Sequence[CellPicture]) -> None:
        self._pictures = pictures
        self._window: Window | None = None

    def draw(self, frames: Sequence[CellFrame]) -> npt.NDArray[np.uint8]:
        """Draw the given moments of the cells."""
        pairs = zip(self._pictures, frames, strict=True)
        return np.concatenate([one.picture(frame, _SIZE) for one, frame in pairs], axis=1)

    def show(self, picture: npt.NDArray[np.uint8]) -> None:
        """Show a picture in the window, at most 25 per second."""
        size = (picture.shape[1], picture.shape[0])
        if self._window is None:
            self._window = Window(size, "fmugym.lab")
        if not self._window.is_closed:
            surface = pygame.image.frombuffer(picture.tobytes(), size, "RGB")
            self._window.show(surface, 25)

    def close(self) -> None:
        """Close the window; a second call does nothing."""
        if self._window is not None:
            self._window.close()
