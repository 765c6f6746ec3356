"""Colours of the bundled scenes, as red, green and blue from 0 to 255."""

from typing import Final

from fmugym.rendering.canvas import Color

BACKGROUND: Final[Color] = (250, 249, 246)
SHADE: Final[Color] = (238, 238, 234)
FAINT: Final[Color] = (214, 219, 226)
MUTED: Final[Color] = (116, 129, 148)
STEEL: Final[Color] = (84, 104, 130)
INK: Final[Color] = (36, 48, 65)
ACCENT: Final[Color] = (232, 93, 47)
