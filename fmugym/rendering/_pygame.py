"""Import of pygame without its greeting and without the warnings of its own imports.

The modules of this package import pygame from here. An environment variable switches the greeting
off. It is set during the import only, so that it does not affect other programs.
"""

import os
import warnings

_GREETING = "PYGAME_HIDE_SUPPORT_PROMPT"
_before = os.environ.get(_GREETING)
os.environ[_GREETING] = "1"
try:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pygame
        import pygame.pkgdata  # imports the deprecated pkg_resources if it is installed
finally:
    if _before is None:
        del os.environ[_GREETING]
    else:
        os.environ[_GREETING] = _before

__all__ = ["pygame"]
