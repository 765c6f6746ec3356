"""The renderer: draws the frames of a scene into a window or into arrays."""

from typing import Final, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fmugym.checks import check_number, check_option, check_text, has_method
from fmugym.errors import ConfigError, shown
from fmugym.rendering import palette
from fmugym.rendering._pygame import pygame
from fmugym.rendering.canvas import Canvas, World, checked_size
from fmugym.rendering.overlay import Overlay
from fmugym.rendering.window import Window

FrameT = TypeVar("FrameT")
FrameT_contra = TypeVar("FrameT_contra", contravariant=True)

_RENDER_MODES: Final = ("human", "rgb_array")


class Scene(Protocol[FrameT_contra]):
    """Scene of a picture: the visible part of the world, and a function that draws a frame.

    A frame describes one moment. It may be any object; a frozen dataclass works well. Values may
    be NaN or far out of view, because the canvas omits or clips such shapes.
    """

    @property
    def world(self) -> World:
        """The part of the world that every picture shows."""
        ...

    def draw(self, canvas: Canvas, frame: FrameT_contra) -> None:
        """Draw a frame on a cleared canvas."""
        ...


class Renderer(Generic[FrameT]):
    """Draws the frames of a scene into a window or into arrays.

    The first frame allocates the memory and opens the window. Arrays need no display. A window
    that the user closes stays closed: the log says so once, and further frames do nothing.

    Args:
        scene: The scene to draw.
        size: Width and height of the picture, in pixels.
        fps: Largest number of frames per second in a window; usually 1 / time step.
        render_mode: "human" for a window, "rgb_array" for arrays.
        title: Title of the window.

    Raises:
        ConfigError: If an argument has a wrong type or is out of its range.
    """

    def __init__(
        self,
        scene: Scene[FrameT],
        size: tuple[int, int] = (600, 400),
        fps: float = 50.0,
        render_mode: str = "rgb_array",
        title: str = "fmugym",
    ) -> None:
        self.render_mode = check_option("render_mode", render_mode, _RENDER_MODES)
        if not has_method(scene, "draw") or not hasattr(scene, "world"):
            raise ConfigError(f"a scene needs a method draw and a world: {shown(scene)}")
        self.scene = scene
        self.size = checked_size(size)
        self.fps = check_number("fps", fps, positive=True, may_be_infinite=True)
        self.title = check_text("title", title)
        self._canvas: Canvas | None = None
        self._window: Window | None = None

    def render(self, frame: FrameT, overlay: Overlay | None = None) -> NDArray[np.uint8] | None:
        """Draw one frame.

        Args:
            frame: The moment to draw.
            overlay: Figures at the top of the picture.

        Returns:
            A new array of shape (height, width, 3) in the mode "rgb_array", otherwise None.

        Raises:
            ConfigError: If a window needs a display and there is none, or if the frame or the
                overlay has a wrong type.
        """
        if overlay is not None and not isinstance(overlay, Overlay):
            raise ConfigError(f"expected an Overlay or None, not {shown(overlay)}")
        if self.render_mode == "rgb_array":
            return _to_array(self._draw(frame, overlay))
        if self._window is None:
            self._window = Window(self.size, self.title)
        if not self._window.is_closed:
            self._window.show(self._draw(frame, overlay), self.fps)
        return None

    def close(self) -> None:
        """Close the window if no other renderer uses it; a second call does nothing.

        The window does not open again. Arrays remain available.
        """
        self._canvas = None
        if self._window is not None:
            self._window.close()

    def _draw(self, frame: FrameT, overlay: Overlay | None) -> pygame.Surface:
        if self._canvas is None:
            self._canvas = Canvas(self.size, self.scene.world)
        self._canvas.clear(palette.BACKGROUND)
        with np.errstate(all="ignore"):  # a state far out of range may overflow
            self.scene.draw(self._canvas, frame)
        if overlay is not None:
            overlay.draw(self._canvas)
        return self._canvas.picture()


def _to_array(picture: pygame.Surface) -> NDArray[np.uint8]:
    """Return a writable copy of the pixels, shape (height, width, 3)."""
    width, height = picture.get_size()
    pixels = bytearray(pygame.image.tobytes(picture, "RGB"))
    return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, 3)
