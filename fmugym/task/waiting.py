"""Steps in Python, counted until compiling the hooks is worth its time."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Final

__all__ = ["STEPS_BEFORE", "Waiting"]

STEPS_BEFORE: Final = 1000
"""After so many steps in Python, ``hooks="auto"`` compiles the hooks."""

_PLAYER: Final = "fmugym.single"
"""The room of ``Player``. It lies above ``env``, and it takes a while to import."""


class Waiting:
    """Stands for the player of an environment before that is made.

    Args:
        required: Whether the hooks must be compiled, in the first step.
    """

    def __init__(self, required: bool) -> None:
        self._required = required
        self._left = 0 if required else STEPS_BEFORE

    def ready(self, env: Any, action: Any) -> Any:
        """Count a step, and make the player if there were enough; see ``Player.ready``."""
        if self._left > 0:
            self._left -= 1
            return None
        env._player = import_module(_PLAYER).Player(self._required)
        return env._player.ready(env, action)
