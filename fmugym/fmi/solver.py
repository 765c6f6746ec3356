"""Integrating the equations of one FMU of model exchange, and handling its events.

This is the arithmetic of ``native/solver.c``, operation by operation.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

from fmugym.fmi.clocks import TICKS_SIZE, CallError, Ticks, Timetable
from fmugym.fmi.crossings import Bracket, crosses
from fmugym.fmi.equations import Equations
from fmugym.fmi.methods import METHODS, State
from fmugym.fmi.status import Status

__all__ = ["Memory", "Mode", "Solver", "Solving"]

_MOST_UPDATES: Final = 1000
_MOST_EVENTS: Final = 100_000
_MOST_GUESSES: Final = 200
_GROWTH: Final = 6.0
_SHRINKAGE: Final = 0.2
_SAFETY: Final = 0.9
_SMALL: Final = 0.01
_FIRST: Final = 0.01
_SHARP: Final = 1e-3
_ROOT: Final = 2.0**-26
_ROUNDED: Final = 1.0 + 1e-6
"""A step may be longer than allowed by a rounding."""
_EPSILON: Final = sys.float_info.epsilon
_LARGEST: Final = sys.float_info.max


@dataclass(frozen=True)
class Solving:
    """How the equations of an FMU are solved.

    Attributes:
        solver: The method, one of ``METHODS``.
        tolerance: Relative.
        max_step: The longest step in seconds; infinite for no limit.
    """

    solver: str = "dormand_prince"
    tolerance: float = 1e-6
    max_step: float = math.inf


_MEMORY: Final = struct.Struct("=dddqq")


class Mode(IntEnum):
    """Where the FMU is in FMI's state machine of model exchange."""

    BEFORE_EVENTS = 0
    IN_EVENTS = 1
    IN_CONTINUOUS_TIME = 2


@dataclass(frozen=True)
class Memory:
    """What the solver keeps between two steps, and all that it adds to a saved state.

    Attributes:
        time: The current time in seconds.
        next_event: The time of the next time event; infinite if there is none.
        step: The step size that an adaptive method tries next; 0 for none yet.
        mode: Of the FMU.
        terminated: Whether the FMU has asked to stop.
        ticks: What is kept of the clocks.
    """

    time: float = 0.0
    next_event: float = math.inf
    step: float = 0.0
    mode: Mode = Mode.BEFORE_EVENTS
    terminated: bool = False
    ticks: tuple[Ticks, ...] = ()

    @staticmethod
    def size(clocks: int) -> int:
        """Bytes of a serialized memory."""
        return _MEMORY.size + clocks * TICKS_SIZE

    def to_bytes(self) -> bytes:
        """Serialize it as the native pool does."""
        own = _MEMORY.pack(self.time, self.next_event, self.step, self.mode, self.terminated)
        return own + b"".join(ticks.to_bytes() for ticks in self.ticks)

    @classmethod
    def from_bytes(cls, data: bytes) -> Memory:
        """Read what ``to_bytes`` made."""
        time, next_event, step, mode, terminated = _MEMORY.unpack(data[: _MEMORY.size])
        places = range(_MEMORY.size, len(data), TICKS_SIZE)
        ticks = tuple(Ticks.from_bytes(data[i : i + TICKS_SIZE]) for i in places)
        return cls(time, next_event, step, Mode(mode), bool(terminated), ticks)


class Solver:
    """Integrates the equations of one instance.

    Args:
        equations: The functions of the FMU.
        solving: The method and its tolerance.
        complain: Logs why the solver gives up.

    Attributes:
        memory: What is saved with the FMU's state.
        x: The states at the time of the memory.
        rates: Their derivatives.
    """

    def __init__(
        self, equations: Equations, solving: Solving, complain: Callable[[str], None]
    ) -> None:
        self._fmu, self._solving, self._complain = equations, solving, complain
        self._method = METHODS[solving.solver]()
        self._n = equations.number_of_states
        self.timetable = Timetable(equations.clocks, equations)
        self.x: State = []
        self.rates: State = []
        self.forget(Memory())

    @property
    def time(self) -> float:
        """The current time in seconds."""
        return self.memory.time

    def forget(self, memory: Memory) -> None:
        """Take over a memory, and read everything else from the FMU when it is needed."""
        self.memory = memory
        if memory.ticks:
            self.timetable.ticks = list(memory.ticks)
        self._stale = True
        self._fmu_time = math.nan  # of the FMU; it must be set
        self._knows_rates = self._knows_indicators = False
        self._jacobian: list[State] | None = None

    @property
    def saved_memory(self) -> Memory:
        """The memory with that of the clocks."""
        return replace(self.memory, ticks=tuple(self.timetable.ticks))

    def _remember(self, **changes: object) -> None:
        self.memory = replace(self.memory, **changes)  # type: ignore[arg-type]  # names of its fields

    def _fail(self, text: str) -> CallError:
        self._complain(text)
        return CallError(Status.ERROR)

    # Calls of the FMU.

    def _place(self, time: float, x: State) -> None:
        if time != self._fmu_time:
            self._fmu_time = math.nan
            self._fmu.set_time(time)
            self._fmu_time = time
        if self._n:
            self._fmu.set_states(x)

    def _indicators(self) -> State:
        return self._fmu.get_indicators() if self._fmu.number_of_indicators else []

    def rates_at(self, time: float, x: State) -> State:
        """The derivatives of the states at a time."""
        self._place(time, x)
        return self._fmu.get_rates() if self._n else []

    def _read_states(self) -> None:
        """Read the states and their nominal values, which an event may have changed."""
        self.x = self._fmu.get_states() if self._n else []
        adaptive = self._n and self._method.order
        nominals = map(abs, self._fmu.get_nominals() if adaptive else [0.0] * self._n)
        self._nominals = [value if 0.0 < value <= _LARGEST else 1.0 for value in nominals]
        self._fmu_time = math.nan
        self._stale = self._knows_rates = self._knows_indicators = False
        self._jacobian = None

    def _know(self) -> None:
        """Find out what is not yet known of the equations at the current time and states."""
        if not self._knows_rates:
            self.rates = self.rates_at(self.time, self.x)
        if not self._knows_indicators:
            self._z = self._indicators()
        self._knows_rates = self._knows_indicators = True

    # Events.

    def enter_events(self) -> None:
        """Go from continuous time to event mode."""
        self._remember(mode=Mode.IN_EVENTS)
        self._fmu.enter_events()

    def settle(self) -> None:
        """Go from event mode to continuous time, unless the FMU asks to stop."""
        self.timetable.activate(self.time)
        for _ in range(_MOST_UPDATES):
            self.timetable.watch()
            events = self._fmu.update()
            if not events.again or events.terminate:
                break
        else:
            raise self._fail(
                f"the discrete states at t = {self.time:g} s do not settle in "
                f"{_MOST_UPDATES} updates"
            )
        self._remember(terminated=self.memory.terminated or events.terminate)
        if not events.terminate:
            self.timetable.plan(self.time)
            self._remember(next_event=min(events.next_event, self.timetable.next))
            self._fmu.enter_continuous()
            self._remember(mode=Mode.IN_CONTINUOUS_TIME)
            self._read_states()

    def _handle_event(self) -> None:
        self._events += 1
        if self._events > _MOST_EVENTS:
            raise self._fail(
                f"the model has more than {_MOST_EVENTS} events in a step, the last at "
                f"t = {self.time:.17g} s"
            )
        self.enter_events()
        self.settle()

    def _locate(self, end: float, after: State, z_after: State) -> tuple[float, State]:
        """Find the first crossing in a step.

        Returns:
            The time just after it, and the states there. The FMU is there.
        """
        time, step = self.time, end - self.time
        resolution = 4.0 * _EPSILON * max(abs(time), abs(end)) / step
        width = max(_SHARP * self._solving.tolerance, resolution)
        bracket = Bracket(0.0, 1.0, 1.0, 1.0, self._z, z_after)
        for guesses in range(_MOST_GUESSES):
            if not bracket.high - bracket.low > width:
                break
            guess = bracket.next_guess(guesses, 0.5 * width)
            self._go_to(end, guess)
            z = self._indicators()
            bracket = bracket.narrowed(guess, z, crosses(self._z, z))
        if bracket.high == 1.0:
            self._place(end, after)
            return end, after
        found = self._go_to(end, bracket.high)
        self._indicators()
        return time + bracket.high * step, found

    def _go_to(self, end: float, fraction: float) -> State:
        found = self._method.between(self, end, fraction)
        self._place(self.time + fraction * (end - self.time), found)
        return found

    # Steps.

    def norm(self, errors: State, end: State) -> float:
        """The root mean square of errors, each divided by the tolerance of its state."""
        total = 0.0
        for error, x, after, nominal in zip(errors, self.x, end, self._nominals, strict=True):
            size = max(abs(x), abs(after))
            part = error / (self._solving.tolerance * (size + _SMALL * nominal))
            total += part * part
        return math.sqrt(total / self._n) if self._n else 0.0

    def differentiate(self, step: float) -> tuple[list[State], State]:
        """The derivatives of the rates by the states, row by row, and by the time."""
        if self._jacobian is None:
            self._place(self.time, self.x)
            columns = [self._differentiate_by(state) for state in range(self._n)]
            self._jacobian = [list(row) for row in zip(*columns, strict=True)]
        later = self.time + max(1e-4 * step, _ROOT * abs(self.time))
        return self._jacobian, self._slope(self.rates_at(later, self.x), later - self.time)

    def _slope(self, rates: State, change: float) -> State:
        """How fast the rates change from those at x, per change."""
        inverse = 1.0 / change
        return [(b - a) * inverse for a, b in zip(self.rates, rates, strict=True)]

    def _differentiate_by(self, state: int) -> State:
        column = self._fmu.differentiate_by(state)
        if column is not None:
            return column
        value, trial = self.x[state], list(self.x)
        trial[state] = value + _ROOT * max(abs(value), 1e-3 * self._nominals[state])
        change = trial[state] - value  # as rounded
        return self._slope(self.rates_at(self.time, trial), change)

    def _resolution(self, until: float) -> float:
        """Two times that are this close are the same."""
        return 16.0 * _EPSILON * max(abs(self.time), abs(until))

    def _first_step(self) -> float:
        """In the first step each state changes by a small part of its value."""
        total = 0.0
        for x, rate, nominal in zip(self.x, self.rates, self._nominals, strict=True):
            part = rate / (abs(x) + _SMALL * nominal)
            total += part * part
        return _FIRST / math.sqrt(total / self._n) if total > 0.0 else math.inf

    def _size_of_step(self, remaining: float) -> float:
        """Divide what remains so that no very short step is left at the end."""
        most = self._solving.max_step
        if not self._method.order:
            return remaining / max(1.0, math.ceil(remaining / (_ROUNDED * most)))
        if not self.memory.step > 0.0:
            self._remember(step=self._first_step())
        size = min(self.memory.step, most)
        if remaining <= min(1.1 * size, _ROUNDED * most):
            return remaining
        return 0.5 * remaining if remaining < 2.0 * size else size

    def _factor_after(self, error: float) -> float:
        if not error > 0.0:
            return _GROWTH
        factor = _SAFETY * math.pow(error, -1.0 / self._method.order)
        return min(_GROWTH, max(_SHRINKAGE, factor))

    def _accept(self, size: float, error: float) -> None:
        """Propose a next step; one that was shorter than proposed tells little of its length."""
        proposed = size * self._factor_after(error)
        kept = self.memory.step
        self._remember(step=max(kept, proposed) if size < kept else proposed)

    def _take_step(self, until: float) -> tuple[float, State]:
        """Try shorter and shorter steps until the error is within the tolerance."""
        remaining = until - self.time
        size = self._size_of_step(remaining)
        while True:
            end = until if size >= remaining else self.time + size
            try:
                after, error = self._method.step(self, end)
            except CallError as failure:
                if not self._method.order or failure.status != Status.DISCARD:
                    raise
                error = math.inf
            if not self._method.order:
                return end, after
            if error <= 1.0:
                self._accept(size, error)
                return end, after
            finite = error <= _LARGEST
            size *= min(_SAFETY, self._factor_after(error)) if finite else _SHRINKAGE
            self._remember(step=size)
            if size < self._resolution(until):
                raise self._fail(
                    f"the solver {self._method.name} needs steps below {size:.3g} s at "
                    f"t = {self.time:.17g} s"
                )

    def _move_on(self, end: float, after: State, z: State, interrupted: bool) -> None:
        """Make the end of a step the current time. The FMU is there already."""
        self._remember(time=end)
        self.x, self._z = after, z
        rates = self._method.end_rates
        self._knows_rates = rates is not None and not interrupted
        self._knows_indicators = not interrupted
        self._jacobian = None
        if rates is not None and not interrupted:
            self.rates = rates

    def _leave_zero(self, until: float) -> tuple[float, State] | None:
        """Take a very short step if an indicator is 0, and return its end if that is an event.

        As the states move, the indicator may become positive at once, and the sign after a whole
        step would not tell: a ball that bounces may be down again.
        """
        if 0.0 not in self._z:
            return None
        end = self.time + self._resolution(until)
        size = end - self.time
        after = [x + size * rate for x, rate in zip(self.x, self.rates, strict=True)]
        self._place(end, after)
        return (end, after) if crosses(self._z, self._indicators()) else None

    def _step_to(self, until: float) -> None:
        """Take one step, to this time or the first event."""
        self._know()
        left = self._leave_zero(until)
        event, z = left is not None, self._z
        end, after = left or self._take_step(until)
        if not event:
            if self._method.end_rates is None:  # the last stage of the others was there
                self._place(end, after)
            z = self._indicators()
            event = crosses(self._z, z)
            if event:
                end, after = self._locate(end, after, z)
        self._move_on(end, after, z, event)
        if self._fmu.completes:
            wants_event, terminate = self._fmu.complete()
            event = event or wants_event
            self._remember(terminated=self.memory.terminated or terminate)
        if event and not self.memory.terminated:
            self._handle_event()

    def _handle_time_event(self) -> None:
        self._remember(time=max(self.time, self.memory.next_event))
        if not self._fmu.steps_by_itself:
            self._place(self.time, self.x)
        self._handle_event()

    def _step_by_fmu(self, until: float) -> None:
        """Let the FMU step to this time, or until it wants an event or returns early."""
        time = self.time
        reached, event, terminate = self._fmu.step(time, until - time)
        progress = reached > time or event or terminate
        if not progress or reached > until + self._resolution(until):
            raise self._fail(
                f"the FMU returned from a step from t = {time:.17g} s to {until:.17g} s at "
                f"{reached:.17g} s"
            )
        terminated = self.memory.terminated or terminate
        self._remember(time=min(max(time, reached), until), terminated=terminated)
        if event and not terminate:
            self._handle_event()

    def begin_step(self, time: float) -> None:
        """Begin a communication step."""
        if self._fmu.steps_by_itself:  # the end of the last step may differ by its rounding
            self._remember(time=time)
        self.timetable.begin_step()

    def advance(self, until: float) -> int:
        """Integrate to this time, and handle all events until then and at it; return the status."""
        try:
            return self._advance(until)
        except CallError as failure:
            if failure.reason:
                self._complain(failure.reason)
            return failure.status

    def _advance(self, until: float) -> int:
        step_to = self._step_by_fmu if self._fmu.steps_by_itself else self._step_to
        self._events = 0
        if self.memory.mode is Mode.IN_EVENTS and not self.memory.terminated:
            self.settle()
        elif self._stale:
            self._read_states()
        while not self.memory.terminated:
            resolution = self._resolution(until)
            if self.memory.next_event <= self.time + resolution:
                self._handle_time_event()
            elif self.time < until - resolution:
                step_to(min(until, self.memory.next_event))
            else:
                self._remember(time=max(self.time, until))
                return Status.OK
        return Status.TERMINATED
