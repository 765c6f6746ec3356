"""What every FMI version tells the FMU of a simulation before it begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

__all__ = ["Initialize", "Span"]


class Span(NamedTuple):
    """The data that the FMU gets at the start of a simulation; see ``Instance.initialize``."""

    start_time: float
    stop_time: float | None
    tolerance: float | None

    @property
    def times(self) -> tuple[float, bool, float]:
        """Start time, whether there is a stop time, and the stop time."""
        return self.start_time, self.stop_time is not None, self.stop_time or 0.0

    @property
    def tolerances(self) -> tuple[bool, float]:
        """Whether there is a tolerance, and the tolerance."""
        return self.tolerance is not None, self.tolerance or 0.0


Initialize = Callable[[Span, Callable[[], None]], None]
"""Takes the span of the simulation and the function that sets the start values."""
