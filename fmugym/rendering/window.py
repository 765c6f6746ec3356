"""The window of pygame, which all renderers of a process share."""

import logging
from typing import ClassVar, Final
from weakref import WeakSet

from fmugym.errors import ConfigError
from fmugym.rendering._pygame import pygame

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
