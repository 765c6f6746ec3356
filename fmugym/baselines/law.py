"""Control laws: controllers given by formulas, which are played and exported alike."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fmugym.baselines.controller import Controller, NumberOrArray
from fmugym.expressions.value import Value
from fmugym.pool.base import FloatArray

__all__ = ["Decided", "Law"]

Decided = tuple[Sequence[Any], tuple[Any, ...]]
"""Elements of an action before the limits, and the new memory of a controller."""


class Law(Controller):
    """Controller given by formulas of the observation and a few remembered numbers.

    Attributes:
        starts: The numbers that it remembers, at the beginning of an episode.
        signals: The attributes that are signals.
    """

    starts: tuple[NumberOrArray, ...] = ()
    _before: tuple[Sequence[Any], Sequence[Any]]
    signals: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def law(
        self, seen: Sequence[Any], state: Sequence[Any], holds: Any = False, added: Any = None
    ) -> Decided:
        """Compute a decision: of arrays element by element, or of formulas.

        Args:
            seen: The elements of the observation.
            state: Memory of the controller, in the order of ``starts``.
            holds: Whether an integral must not grow, because nothing would follow it.
            added: Correction of each element of the action; None for nothing. See
                ``Controller.add``.
        """

    @property
    def integrates(self) -> bool:
        """Whether it has an integral, which may wind up."""
        return False

    def wanted(self, seen: Sequence[Any], state: Sequence[Any]) -> Any:
        """The action that it would take if there were no limits, as its only element."""
        return self.law(seen, state)[0][0]

    def measured(self) -> list[str]:
        """Measured value and set point: names and other expressions."""
        given = (getattr(self, name) for name in self.signals)
        return [one for one in given if isinstance(one, str)]

    def decision(
        self,
        observation: Sequence[Value],
        memory: Sequence[Value] = (),
        added: Sequence[Value] | None = None,
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """See ``Controller.decision``."""
        elements, state = self.law(observation, memory, added=added)
        return [observation[0].beside(one) for one in elements], state

    def _prepare(self) -> None:
        for name in self.signals:
            if (signal := getattr(self, name)) is not None:
                self._check_signal(name, signal)
        self._state = tuple(np.full(self.count, start) for start in self.starts)

    def _forget(self, mask: npt.NDArray[np.bool_]) -> None:
        pairs = zip(self.starts, self._state, strict=True)
        self._state = tuple(np.where(mask, start, now) for start, now in pairs)

    def add(self, added: FloatArray) -> None:
        """See ``Controller.add``."""
        _, self._state = self.law(*self._before, added=[*added.T])

    def _decide(self, rows: FloatArray) -> FloatArray:
        self._before = [*rows.T], self._state
        elements, self._state = self.law(*self._before)
        return np.stack([np.broadcast_to(one, len(rows)) for one in elements], axis=-1)
