"""The renderer: frames of a scene in, pictures in a window or in arrays out."""

from typing import Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fmugym.errors import ConfigError
from fmugym.rendering import palette
from fmugym.rendering._pygame import pygame
from fmugym.rendering.canvas import Canvas, World
from fmugym.rendering.overlay import Overlay
from fmugym.rendering.window import Window

FrameT = TypeVar("FrameT")
FrameT_contra = TypeVar("FrameT_contra", contravariant=True)

_RENDER_MODES: Final = ("human", "rgb_array")


class Scene(Protocol[FrameT_contra]):
    """What a picture shows: the part of the world in view, and how a frame is drawn.

    A frame is whatever the scene needs to know of one moment, best a frozen dataclass. Values may
    be NaN or far out of view: the canvas leaves out or clips such shapes.
    """

    @property
    def world(self) -> World:
        """The part of the world that is sure to be in the picture."""
        ...

    def draw(self, canvas: Canvas, frame: FrameT_contra) -> None:
        """Draw a frame on a canvas that was cleared before."""
        ...


class Renderer(Generic[FrameT]):
    """Draws the frames of a scene, in a window or in arrays.

    Nothing is allocated or opened before the first frame. Arrays need no display. A window that
    the user closes stays closed: that is said once in the log, and further frames do nothing.

    Args:
        scene: What to draw.
        size: Width and height of the picture, in pixels.
        fps: Largest number of frames a second in a window; usually one over the time step.
        render_mode: "human" for a window, "rgb_array" for arrays.
        title: Title of the window.

    Raises:
        ConfigError: If the render mode is neither of the two.
    """

    def __init__(
        self,
        scene: Scene[FrameT],
        size: tuple[int, int] = (600, 400),
        fps: float = 50.0,
        render_mode: str = "rgb_array",
        title: str = "fmugym",
    ) -> None:
        if render_mode not in _RENDER_MODES:
            raise ConfigError(f"render_mode must be one of {_RENDER_MODES}, not {render_mode!r}")
        self.scene = scene
        self.size = size
        self.fps = fps
        self.render_mode = render_mode
        self.title = title
        self._canvas: Canvas | None = None
        self._window: Window | None = None

    def render(self, frame: FrameT, overlay: Overlay | None = None) -> NDArray[np.uint8] | None:
        """Draw one frame.

        Args:
            frame: The moment to draw.
            overlay: Figures for the corner of the picture.

        Returns:
            A new array of shape (height, width, 3) in the mode "rgb_array", otherwise None.
        """
        if self.render_mode == "rgb_array":
            return _to_array(self._draw(frame, overlay))
        if self._window is None:
            self._window = Window(self.size, self.title)
        if not self._window.is_closed:
            self._window.show(self._draw(frame, overlay), self.fps)
        return None

    def close(self) -> None:
        """Close the window, if this renderer is the last to use it; a second call does nothing.

        A window that was closed is not opened again; arrays are still made.
        """
        self._canvas = None
        if self._window is not None:
            self._window.close()

    def _draw(self, frame: FrameT, overlay: Overlay | None) -> pygame.Surface:
        if self._canvas is None:
            self._canvas = Canvas(self.size, self.scene.world)
        self._canvas.clear(palette.BACKGROUND)
        with np.errstate(all="ignore"):  # a state far out of range may overflow on its way
            self.scene.draw(self._canvas, frame)
        if overlay is not None:
            overlay.draw(self._canvas)
        return self._canvas.picture()


def _to_array(picture: pygame.Surface) -> NDArray[np.uint8]:
    """Return a writable copy of the pixels, shape (height, width, 3)."""
    width, height = picture.get_size()
    pixels = bytearray(pygame.image.tobytes(picture, "RGB"))
    return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, 3)
