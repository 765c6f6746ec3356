"""The window of pygame, shared by all renderers of a process."""

import logging
from typing import ClassVar
from weakref import WeakSet

from fmugym.rendering._pygame import pygame

logger = logging.getLogger(__name__)
_KEYS = (pygame.KEYDOWN, pygame.KEYUP)


class Window:
    """A share in the one window that pygame has per process.

    Shares of different sizes resize the window in turn. The display is opened with the first
    picture and given back with the last share, unless somebody else had opened it. When the user
    closes the window it disappears for all shares, and their further pictures are not shown.

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
        """Show a picture, and wait so that there are no more than `fps` a second.

        Args:
            picture: A picture of the window's size.
            fps: Largest number of pictures a second.
        """
        surface = self._open()
        if _is_quit_requested():
            self._dismiss()
            return
        surface.blit(picture, (0, 0))
        pygame.display.flip()
        self._clock.tick(fps)

    def close(self) -> None:
        """Give the share back; a second call does nothing."""
        self.is_closed = True
        if self in Window._shares:
            Window._shares.remove(self)
            Window._close_unused_display()

    def _open(self) -> pygame.Surface:
        Window._shares.add(self)
        if not pygame.display.get_init():
            pygame.display.init()
            Window._is_display_ours = True
        surface = pygame.display.get_surface()
        if surface is None or surface.get_size() != self._size:
            surface = pygame.display.set_mode(self._size)
            pygame.display.set_caption(self._title)
        return surface

    def _dismiss(self) -> None:
        logger.warning("The window was closed; the environment goes on without it.")
        for share in tuple(Window._shares):
            share.close()

    @classmethod
    def _close_unused_display(cls) -> None:
        if cls._is_display_ours and not cls._shares:
            cls._is_display_ours = False
            pygame.display.quit()


def _is_quit_requested() -> bool:
    """Empty the event queue but for the keys, which a program may read to steer an environment."""
    return any(event.type == pygame.QUIT for event in pygame.event.get(exclude=_KEYS))
