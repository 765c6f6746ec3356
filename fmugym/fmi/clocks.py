"""When the clocks of an FMU of FMI 3.0 tick.

This does what ``native/clocks.c`` does, operation by operation.
"""

from __future__ import annotations

import math
import struct
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from enum import IntEnum
from typing import Final, NamedTuple

from fmugym.archive.variable import CLOCK_KINDS, MOST_FRACTIONS, Interval, Variable
from fmugym.fmi.status import Status

__all__ = ["TICKS_SIZE", "CallError", "ClockCalls", "Qualifier", "Ticks", "Timetable"]

_TICKS: Final = struct.Struct("=ddqqqq")
TICKS_SIZE: Final = _TICKS.size
"""Bytes of serialized ticks."""

_ROUNDING: Final = 16.0 * sys.float_info.epsilon
_MAY_CHANGE: Final = ("tunable", "changing")
_PERIODIC: Final = CLOCK_KINDS[:5]


class CallError(Exception):
    """A call of the FMU returned a status worse than a warning, or the solver gives up."""

    def __init__(self, status: int, reason: str = "") -> None:
        super().__init__(status)
        self.status, self.reason = status, reason


class Qualifier(IntEnum):
    """What an FMU says of an interval that it tells."""

    NOT_YET_KNOWN = 0
    UNCHANGED = 1
    CHANGED = 2


class Ticks(NamedTuple):
    """What is kept of a clock. Its next tick is so many intervals after its origin.

    Attributes:
        origin: A time in seconds.
        interval: Between two ticks.
        passed: The intervals since the origin; with a fraction, the parts of a second that its
            resolution gives.
        ticked: Whether it ticked in the last communication step, or at the start.
    """

    origin: float = math.inf
    interval: Interval = Interval(0.0)
    passed: int = 0
    ticked: bool = False

    @property
    def next(self) -> float:
        """The time of the next tick."""
        if self.interval.resolution:
            return self.origin + self.passed / self.interval.resolution
        return self.origin + self.passed * self.interval.seconds

    def changed_to(self, interval: Interval) -> Ticks:
        """A new interval begins with the next tick."""
        a, b = self.interval.resolution, interval.resolution
        if a and b:
            common = math.lcm(a, b)
            passed, counter = self.passed * (common // a), interval.counter * (common // b)
            if max(common, passed, counter) <= MOST_FRACTIONS:
                new = Interval(interval.seconds, counter, common)
                return self._replace(interval=new, passed=passed)
        return self._replace(origin=self.next, interval=interval, passed=0)

    def advanced(self) -> Ticks:
        """Go on to the tick after the next one."""
        passed = self.passed + (self.interval.counter if self.interval.resolution else 1)
        if passed > MOST_FRACTIONS:
            return Ticks(self._replace(passed=passed).next, self.interval, 0, self.ticked)
        return self._replace(passed=passed)

    def to_bytes(self) -> bytes:
        """Serialize them as the native pool does."""
        return _TICKS.pack(self.origin, *self.interval, self.passed, self.ticked)

    @classmethod
    def from_bytes(cls, data: bytes) -> Ticks:
        """Read what ``to_bytes`` made."""
        origin, *interval, passed, ticked = _TICKS.unpack(data)
        return cls(origin, Interval(*interval), passed, bool(ticked))


class ClockCalls(ABC):
    """The functions of one instance for clocks. All raise ``CallError`` for a bad status."""

    @abstractmethod
    def is_active(self, clock: Variable) -> bool:
        """Whether an output clock ticks now."""

    @abstractmethod
    def activate(self, clock: Variable) -> None:
        """Let an input clock tick now."""

    @abstractmethod
    def interval(self, clock: Variable) -> tuple[Interval, Qualifier]:
        """Ask for the interval, which says nothing unless the qualifier is ``CHANGED``."""

    @abstractmethod
    def shift(self, clock: Variable) -> Interval:
        """Ask for the time before the first tick."""

    @abstractmethod
    def set_interval(self, clock: Variable) -> None:
        """Set the interval of a fixed clock."""

    @abstractmethod
    def set_inputs(self, clock: Variable) -> None:
        """Set the inputs that may be set while this clock ticks."""


class Timetable:
    """Lets the clocks of one instance tick.

    Args:
        clocks: The clocks.
        calls: The functions of the instance.

    Attributes:
        ticks: What is saved with the FMU's state, one for each clock.
    """

    def __init__(self, clocks: Sequence[Variable], calls: ClockCalls) -> None:
        self.clocks, self._calls = tuple(clocks), calls
        self._numbers = {c.value_reference: index for index, c in enumerate(self.clocks)}
        self._active = [False] * len(self.clocks)
        self.ticks = [Ticks(0.0)] * len(self.clocks)

    @property
    def next(self) -> float:
        """The time of the next tick; infinite if there is none."""
        return min((ticks.next for ticks in self.ticks), default=math.inf)

    def prepare(self, time: float) -> None:
        """In initialization mode: set or ask for intervals, and plan the first ticks."""
        self._active = [False] * len(self.clocks)
        self.ticks = [self._first(clock, time) for clock in self.clocks]

    def _first(self, clock: Variable, time: float) -> Ticks:
        interval, shift = clock.interval, clock.shift
        if clock.ticking in ("constant", "fixed"):
            self._check(clock, interval, time)  # the XML may give none
        if clock.ticking == "fixed":
            self._calls.set_interval(clock)
        elif clock.ticking in ("calculated", *_MAY_CHANGE):
            interval = self._ask(clock, interval, time)[0]
        if math.isnan(shift.seconds):
            shift = self._checked_fraction(clock, self._calls.shift(clock), time)
        if clock.ticking not in _PERIODIC:
            return Ticks()
        if interval.resolution and shift.resolution:
            return Ticks(time, shift, shift.counter).changed_to(interval)
        return Ticks(time + shift.seconds, interval)

    def _ask(self, clock: Variable, known: Interval, time: float) -> tuple[Interval, Qualifier]:
        interval, qualifier = self._calls.interval(clock)
        if qualifier is not Qualifier.CHANGED:
            return known, qualifier
        interval = self._checked_fraction(clock, interval, time)
        self._check(clock, interval, time)
        return interval, qualifier

    @staticmethod
    def _checked_fraction(clock: Variable, interval: Interval, time: float) -> Interval:
        """Compute the seconds of what the FMU tells as a fraction."""
        _, counter, resolution = interval
        if not clock.by_fractions:
            return interval
        if 0 < resolution <= MOST_FRACTIONS and counter <= MOST_FRACTIONS:
            return Interval.of_fraction(counter, resolution)
        raise CallError(
            Status.ERROR,
            f"the clock with value reference {clock.value_reference} has an interval or shift of "
            f"{counter}/{resolution} s at t = {time:g} s",
        )

    @staticmethod
    def _check(clock: Variable, interval: Interval, time: float) -> None:
        """A clock that repeats too soon would never let time pass."""
        seconds = interval.seconds
        if not (seconds > 0.0 or (clock.ticking == "countdown" and seconds == 0.0)):
            raise CallError(
                Status.ERROR,
                f"the clock with value reference {clock.value_reference} has an interval of "
                f"{seconds:g} s at t = {time:g} s",
            )

    def begin_step(self) -> None:
        """Forget what ticked in the last communication step."""
        self.ticks = [ticks._replace(ticked=False) for ticks in self.ticks]

    def ask(self, references: Sequence[int], values: Sequence[bool]) -> None:
        """Let triggered clocks tick in the next event."""
        for reference, value in zip(references, values, strict=True):
            index = self._numbers.get(reference)
            if value and index is not None and self.clocks[index].settable_in_step:
                self._active[index] = True

    def tell(self, references: Sequence[int]) -> list[bool]:
        """Whether each of these clocks ticked in the last communication step."""
        known = self._numbers
        return [r in known and self.ticks[known[r]].ticked for r in references]

    def activate(self, time: float) -> None:
        """Before the first update of the discrete states: let the clocks tick that are due."""
        latest = time + _ROUNDING * abs(time)
        for index, clock in enumerate(self.clocks):
            self._active[index] |= self.ticks[index].next <= latest
            if self._active[index]:
                self._calls.activate(clock)
                self.ticks[index] = self.ticks[index]._replace(ticked=True)
        for clock, active in zip(self.clocks, self._active, strict=True):
            if active:
                self._calls.set_inputs(clock)

    def watch(self) -> None:
        """Before each update: note which output clocks tick."""
        for index, clock in enumerate(self.clocks):
            is_output = clock.number == len(CLOCK_KINDS)
            if is_output and self._calls.is_active(clock):
                self.ticks[index] = self.ticks[index]._replace(ticked=True)

    def plan(self, time: float) -> None:
        """After the last update: plan the next ticks."""
        for index, clock in enumerate(self.clocks):
            ticked, self._active[index] = self._active[index], False
            if clock.ticking == "countdown":
                self.ticks[index] = self._plan_countdown(clock, self.ticks[index], ticked, time)
            elif ticked and clock.ticking in _PERIODIC:
                self.ticks[index] = self._plan_after_tick(clock, self.ticks[index], time)

    def _plan_countdown(self, clock: Variable, ticks: Ticks, ticked: bool, time: float) -> Ticks:
        interval, qualifier = self._ask(clock, Interval(0.0), time)
        if qualifier is Qualifier.CHANGED:
            return ticks._replace(origin=time + interval.seconds)
        ends = qualifier is Qualifier.NOT_YET_KNOWN or ticked
        return ticks._replace(origin=math.inf) if ends else ticks

    def _plan_after_tick(self, clock: Variable, ticks: Ticks, time: float) -> Ticks:
        """A new interval begins with the tick at which the FMU tells it."""
        interval = ticks.interval
        if clock.ticking in _MAY_CHANGE:
            interval, _ = self._ask(clock, interval, time)
        if interval != ticks.interval:
            ticks = ticks.changed_to(interval)
        self._check(clock, ticks.interval, time)
        return ticks.advanced()
