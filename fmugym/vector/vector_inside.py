"""Internal state of a vector environment, which other modules read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fmugym.env import FMUEnv
from fmugym.pool import Pool
from fmugym.task.specs import EpisodeLimit
from fmugym.vector.attributes import Attributes
from fmugym.vector.engines.engine import Engine
from fmugym.vector.episodes import Episodes
from fmugym.vector.making import EnvMaker

__all__ = ["VectorInside"]


@dataclass(init=False, repr=False, eq=False, slots=True)
class VectorInside:
    """What other modules need of a vector environment: its attribute ``inside``.

    Attributes:
        maker: Makes environments of its class.
        prototype: The first of these, whose task all have.
        pool: Has the FMUs.
        engine: Has what hooks read, and calls them.
        episodes: Saves, restores and tries out episodes.
        attributes: Reads, sets and calls what single environments have.
        limit: The largest number of steps of an episode.
        at_ends: What is called of the actions where episodes have ended; see ``look_at_ends``.
    """

    at_ends: list[Callable[[Any], None]]
    attributes: Attributes
    engine: Engine
    episodes: Episodes
    limit: EpisodeLimit
    maker: EnvMaker
    pool: Pool
    prototype: FMUEnv

    def __init__(self) -> None:
        self.at_ends = []

    def look_at_ends(self, look: Callable[[Any], None]) -> None:
        """Call a function of the actions where episodes have ended and the next have not begun.

        That moment is within a step in the mode ``SAME_STEP``.
        """
        self.engine.starts_at_ends = False
        self.at_ends.append(look)
