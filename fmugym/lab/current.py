"""The lab that a `Client` uses when it is created without one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

from fmugym.errors import SimulationError
from fmugym.lab.service import Service

__all__ = ["CURRENT", "Current"]

Create = Callable[[Service | None], Service]


class Current:
    """The open blocks ``with lab:``, and the default lab.

    A client needs the current lab, and a lab creates clients. To avoid a circle of imports, this
    class does not know `Lab`: the module of `Lab` says how to create the default lab.
    """

    def __init__(self) -> None:
        self._blocks: list[Service] = []
        self._default: Service | None = None
        self._create: Create | None = None
        self._lock = threading.RLock()

    def create_default_by(self, create: Create) -> None:
        """Set the function that returns the default lab, given the last default lab or None."""
        self._create = create

    def enter(self, lab: Service) -> None:
        """Begin a block."""
        with self._lock:
            self._blocks.append(lab)

    def leave(self, lab: Service) -> bool:
        """End a block; returns whether it was the outermost block of this lab."""
        with self._lock:
            self._blocks.remove(lab)
            return lab not in self._blocks

    def get(self) -> Service:
        """Return the lab of the innermost block, or else the default lab."""
        with self._lock:
            if self._blocks:
                return self._blocks[-1]
            if self._create is None:
                raise SimulationError("there is no default lab before fmugym.lab is imported")
            self._default = self._create(self._default)
            return self._default


CURRENT: Final = Current()
"""The state of this process."""
