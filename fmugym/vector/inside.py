"""What other modules need of a vector environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from fmugym.env import FMUEnv
from fmugym.pool import Pool
from fmugym.task.snapshot import Snapshot
from fmugym.vector.engines.base import Engine
from fmugym.vector.episodes import Episodes
from fmugym.vector.making import EnvMaker

if TYPE_CHECKING:
    from fmugym.vector.attributes import Attributes

__all__ = ["VectorInside"]


class VectorInside:
    """What other modules need of a vector environment: its attribute ``inside``.

    Attributes:
        maker: Makes environments of its class.
        prototype: The first of these, whose task all have.
        pool: Has the FMUs.
        engine: Has what hooks read, and calls them.
        episodes: Saves, restores and tries out episodes.
        attributes: Reads, sets and calls what single environments have.
        started: Whether there ever was an episode.
        is_ready: Whether a step may follow.
        at_ends: What is called of the actions where episodes have ended; see ``look_at_ends``.
    """

    __slots__ = (
        *("at_ends", "attributes", "engine", "episodes", "is_ready", "maker", "pool"),
        *("prototype", "started"),
    )

    at_ends: list[Callable[[Any], None]]
    attributes: Attributes
    engine: Engine
    episodes: Episodes
    is_ready: bool
    maker: EnvMaker
    pool: Pool
    prototype: FMUEnv
    started: bool

    def __init__(self) -> None:
        self.started = self.is_ready = False
        self.at_ends = []

    def look_at_ends(self, look: Callable[[Any], None]) -> None:
        """Call a function of the actions where episodes have ended and the next have not begun.

        That moment is within a step in the mode ``SAME_STEP``.
        """
        self.engine.leave_starts()
        self.at_ends.append(look)

    @contextmanager
    def returning_to(self, present: Snapshot | None) -> Iterator[None]:
        """Return to the present episodes afterwards, or to none; nothing starts in between."""
        engine = self.engine
        starts_at_ends, engine.starts_at_ends = engine.starts_at_ends, False
        try:
            yield
        finally:
            engine.starts_at_ends = starts_at_ends
            self.is_ready = False
            if present is not None:
                self.episodes.place(present, np.arange(self.pool.num_instances))
                self.is_ready = True
