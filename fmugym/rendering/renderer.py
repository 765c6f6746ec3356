"""Renderer: draws the frames of a scene into a window or into arrays, with an overlay.

All renderers of a process share the window of pygame. The overlay has the figures of a step, in a
row at the top of a picture.
"""

import logging
from dataclasses import dataclass
from typing import ClassVar, Final, Generic, Protocol, TypeVar
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from fmugym.checks import check_number, check_option, check_text, has_method, number_of
from fmugym.errors import ConfigError, shown
from fmugym.rendering import palette
from fmugym.rendering._pygame import pygame
from fmugym.rendering.canvas import Canvas, World, checked_size

_NONE: Final = "\N{EN DASH}"


@dataclass(frozen=True)
class Overlay:
    """Figures in the upper left corner of a picture: names, and values below them.

    Args:
        time: Time of the episode, in s.
        action: The action as text with its unit, such as "+10.0 N"; "" before the first step.
        reward: Reward of the last step; None before the first step.
        episode_return: Sum of the rewards of the episode; None before the first step.

    Raises:
        ConfigError: If an argument has a wrong type.
    """

    time: float
    action: str = ""
    reward: float | None = None
    episode_return: float | None = None

    def __post_init__(self) -> None:
        check_text("the action of an overlay", self.action)
        for name in ("time", "reward", "episode_return"):
            value = getattr(self, name)
            if value is not None or name == "time":
                object.__setattr__(self, name, number_of(f"{name} of an overlay", value))

    def draw(self, canvas: Canvas) -> None:
        """Write the figures, in a size that follows the width of the picture."""
        unit = canvas.size[0] / 500.0
        for column, (name, value) in enumerate(self._figures()):
            x = round(unit * (18 + 118 * column))
            canvas.caption((x, round(unit * 15)), name, round(unit * 18), palette.MUTED)
            canvas.caption((x, round(unit * 30)), value, round(unit * 26), palette.INK)

    def _figures(self) -> tuple[tuple[str, str], ...]:
        return (
            ("time", f"{_number(self.time)} s"),
            ("reward", _number(self.reward)),
            ("return", _number(self.episode_return)),
            ("action", self.action or _NONE),
        )


def _number(value: float | None) -> str:
    """Return two decimals, or a power of ten for a number too long for its column."""
    if value is None:
        return _NONE
    return f"{value:.3e}" if abs(value) >= 1e7 else f"{value:.2f}"


logger = logging.getLogger(__name__)
_KEYS: Final = (pygame.KEYDOWN, pygame.KEYUP)
_HIGHEST_RATE: Final = 1000.0  # pygame counts in ms


class Window:
    """A share in the one window that pygame has per process.

    Shares of different sizes resize the window in turn. The first picture opens the display, and
    the last share closes it, unless another program part had opened it. If the user closes the
    window, it closes for all shares, and they do not show further pictures.

    Args:
        size: Width and height, in pixels.
        title: Title of the window.
    """

    _shares: ClassVar[WeakSet["Window"]] = WeakSet()
    _is_display_ours: ClassVar[bool] = False

    def __init__(self, size: tuple[int, int], title: str) -> None:
        self._size = size
        self._title = title
        self._clock = pygame.time.Clock()
        self.is_closed = False

    def show(self, picture: pygame.Surface, fps: float) -> None:
        """Show a picture, and wait to keep the rate of pictures.

        Args:
            picture: A picture of the window's size.
            fps: Largest number of pictures per second.

        Raises:
            ConfigError: If there is no display.
        """
        surface = self._open()
        if _is_quit_requested():
            self._dismiss()
            return
        surface.blit(picture, (0, 0))
        pygame.display.flip()
        self._clock.tick(min(fps, _HIGHEST_RATE))

    def close(self) -> None:
        """Give up the share; a second call does nothing."""
        self.is_closed = True
        if self in Window._shares:
            Window._shares.remove(self)
            Window._close_unused_display()

    def _open(self) -> pygame.Surface:
        Window._shares.add(self)
        try:
            return self._surface()
        except pygame.error as error:
            Window._shares.discard(self)
            Window._close_unused_display()
            raise ConfigError(
                f'render_mode="human" needs a display ({error}); use render_mode="rgb_array"'
            ) from error

    def _surface(self) -> pygame.Surface:
        if not pygame.display.get_init():
            pygame.display.init()
            Window._is_display_ours = True
        surface = pygame.display.get_surface()
        if surface is None or surface.get_size() != self._size:
            surface = pygame.display.set_mode(self._size)
            pygame.display.set_caption(self._title.replace("\0", ""))
        return surface

    def _dismiss(self) -> None:
        logger.warning("The window was closed; the environment continues without it.")
        for share in tuple(Window._shares):
            share.close()

    @classmethod
    def _close_unused_display(cls) -> None:
        if cls._is_display_ours and not cls._shares:
            cls._is_display_ours = False
            pygame.display.quit()


def _is_quit_requested() -> bool:
    """Empty the event queue, but keep the keys: a program may steer an environment by them."""
    return any(event.type == pygame.QUIT for event in pygame.event.get(exclude=_KEYS))


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
