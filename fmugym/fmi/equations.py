"""What a solver needs of an FMU: the functions of model exchange of one instance."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from fmugym.archive.variable import Variable
from fmugym.fmi.clocks import ClockCalls
from fmugym.fmi.methods import State

__all__ = ["Equations", "Events"]


class Events(NamedTuple):
    """What the FMU tells after one update of its discrete states."""

    again: bool
    terminate: bool
    next_event: float


class Equations(ClockCalls):
    """The functions of model exchange of one instance. All raise ``CallError`` for a bad status."""

    steps_by_itself: bool = False
    """Whether the FMU does its steps, as in co-simulation with event mode."""
    clocks: Sequence[Variable] = ()
    number_of_states: int
    number_of_indicators: int
    completes: bool
    """Whether the FMU wants to know of complete steps."""

    @abstractmethod
    def set_time(self, time: float) -> None:
        """Set the time."""

    @abstractmethod
    def set_states(self, x: State) -> None:
        """Set the continuous states."""

    @abstractmethod
    def get_states(self) -> State:
        """Get the continuous states."""

    @abstractmethod
    def get_rates(self) -> State:
        """Get the derivatives of the states."""

    @abstractmethod
    def get_indicators(self) -> State:
        """Get the event indicators."""

    @abstractmethod
    def get_nominals(self) -> State:
        """Get the nominal values of the states."""

    @abstractmethod
    def enter_events(self) -> None:
        """Enter event mode."""

    @abstractmethod
    def update(self) -> Events:
        """Update the discrete states once."""

    @abstractmethod
    def enter_continuous(self) -> None:
        """Enter continuous-time mode."""

    @abstractmethod
    def complete(self) -> tuple[bool, bool]:
        """Tell that a step is complete; return whether the FMU wants an event, and to stop."""

    def step(self, time: float, size: float) -> tuple[float, bool, bool]:
        """Let the FMU step.

        Returns:
            The time that it reached, whether it wants an event, and whether it wants to stop.
        """
        raise NotImplementedError

    @abstractmethod
    def differentiate_by(self, state: int) -> State | None:
        """The derivatives of all rates by one state; None if the FMU does not provide them."""
