"""pygame, imported without its greeting and without the warnings of its own imports.

The modules of this package take pygame from here. The greeting is switched off by an environment
variable that is set only during the import, so that a user's other programs are not affected.
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
        import pygame.pkgdata  # imports the deprecated pkg_resources where it is installed
finally:
    if _before is None:
        del os.environ[_GREETING]
    else:
        os.environ[_GREETING] = _before

__all__ = ["pygame"]
