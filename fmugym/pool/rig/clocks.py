"""Clocks of rigs: real time, faster than real time, or moved by hand; steps in real time.

A lab, and whatever is paced, asks its clock what time it is and sleeps on it; nothing else tells it
the time. With any but the default clock a program takes `clock.time` and `clock.sleep` in the place
of `time.time` and `time.sleep`, which the clock does not know of. Steps in real time have options
and a schedule.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np

from fmugym.checks import check_number
from fmugym.pool.pool import FloatArray, MaskArray

__all__ = ["Clock", "ManualClock", "Paced", "RealClock", "TickSchedule", "speed_of"]

_OVERSLEPT: Final = 1e-4
"""What sleeps of systems take longer than asked for, in s: the time given up, but not slept, at the
end of a wait."""


class Clock(Protocol):
    """Clock of a rig; both methods may be called from any thread."""

    def time(self) -> float:
        """Return the time, in s."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait for some time, in s; not at all if that is negative."""
        ...


def speed_of(clock: Clock | None) -> float:
    """Speed of a clock beside real time: 1, unless it has an attribute ``speed``."""
    speed: float = getattr(clock, "speed", 1.0)
    return speed


class RealClock:
    """A clock that runs like the machine's own, or faster.

    Args:
        speed: Seconds of the clock's time per second. What the machine is late by grows with it:
            0.1 ms are 1 ms of the clock's time at ``speed=10``.

    Raises:
        ConfigError: If the speed is not a positive, finite number.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = check_number("speed", speed, positive=True)
        self._start = time.perf_counter()

    def time(self) -> float:
        """Return the time since this clock was made, in s."""
        return (time.perf_counter() - self._start) * self.speed

    def sleep(self, seconds: float) -> None:
        """Wait for some of the clock's time, in s; not at all if that is negative."""
        end = time.perf_counter() + seconds / self.speed
        while (rest := end - time.perf_counter()) > 0.0:
            time.sleep(max(0.0, rest - _OVERSLEPT))


class ManualClock:
    """A clock that stands still until it is moved.

    `advance` moves it. So does `sleep`, which never waits longer than needed: time jumps to the
    first waking as soon as all threads made by `thread` sleep, or at once if there is none.
    Several threads thus take the same turns as in real time, each at its own exact moment.

    Args:
        start: The time to begin with, in s.

    Raises:
        ConfigError: If it is not a finite number.
    """

    def __init__(self, start: float = 0.0) -> None:
        self._now = check_number("start", start)
        self._changed = threading.Condition()
        self._awaited: set[threading.Thread] = set()
        self._working_for: dict[threading.Thread, set[threading.Thread]] = {}
        self._sleepers: dict[threading.Thread, float] = {}

    def time(self) -> float:
        """Return the time, in s."""
        return self._now

    def advance(self, seconds: float) -> None:
        """Move the time on, in s, and wake whoever slept until then.

        Raises:
            ConfigError: If the time would go backwards, or is not a finite number.
        """
        step = check_number("the seconds to advance by", seconds, 0.0)
        with self._changed:
            self._now += step
            self._changed.notify_all()

    def sleep(self, seconds: float) -> None:
        """Wait for some time, in s; see the class for the movement of the clock.

        Raises:
            ConfigError: If the time is not a finite number.
        """
        if check_number("the seconds to sleep", seconds) <= 0.0:
            return
        thread = threading.current_thread()
        with self._changed:
            waking = self._sleepers[thread] = self._now + seconds
            self._jump()
            try:
                while self._now < waking:
                    self._changed.wait()
            finally:
                del self._sleepers[thread]

    def thread(
        self, target: Callable[..., object], args: tuple[Any, ...] = (), name: str | None = None
    ) -> threading.Thread:
        """Make a thread that time waits for, from its `start` until it ends.

        Args:
            target: As for `threading.Thread`; to wait it must sleep on this clock.
            args: As for `threading.Thread`.
            name: As for `threading.Thread`.

        Returns:
            The thread, not started.
        """
        return _AwaitedThread(self, target=target, args=args, name=name)

    @contextmanager
    def handed_over(self, threads: Sequence[threading.Thread]) -> Iterator[None]:
        """Let time wait for threads that work for the caller, in the place of the caller's own.

        Args:
            threads: Each must `leave` when its work is done; with the last of them time waits for
                the caller again, if it did before.
        """
        caller = threading.current_thread()
        with self._changed:
            if caller in self._awaited:
                self._awaited.discard(caller)
                self._working_for[caller] = set(threads)
            self._awaited.update(threads)
            self._jump()
        try:
            yield
        finally:
            for thread in threads:
                self.leave(thread)

    def leave(self, thread: threading.Thread) -> None:
        """Let time wait for a thread no longer."""
        with self._changed:
            self._awaited.discard(thread)
            for caller, threads in list(self._working_for.items()):
                threads.discard(thread)
                if not threads:
                    del self._working_for[caller]
                    self._awaited.add(caller)
            self._jump()

    def _join(self, thread: threading.Thread) -> None:
        with self._changed:
            self._awaited.add(thread)

    def _jump(self) -> None:
        """Go to the first waking if nobody is at work; those overdue are at work."""
        if self._sleepers and self._awaited <= self._sleepers.keys():
            self._now = max(self._now, min(self._sleepers.values()))
            self._changed.notify_all()


class _AwaitedThread(threading.Thread):
    def __init__(self, clock: ManualClock, **options: Any) -> None:
        super().__init__(**options)
        self._clock = clock

    def start(self) -> None:
        self._clock._join(self)
        try:
            super().start()
        except BaseException:
            self._clock.leave(self)
            raise

    def run(self) -> None:
        try:
            super().run()
        finally:
            self._clock.leave(self)


_TOLERANCE: Final = 0.1
"""How late a step may be without counting as a miss, in periods."""

_HOLD_AFTER: Final = 3
"""Periods without a step after which a backend holds, by default."""


@dataclass(frozen=True)
class Paced:
    """A backend that is stepped in real time.

    Each step waits for its tick, one time step after the last tick. Pacing is elastic: a late step
    shifts all ticks that follow.

    Args:
        backend: One backend, a sequence, or a function; see ``BackendPool``.
        clock: Tells the time; by default the machine's clock.
        hold_after: Time without a step after which a backend is asked to ``hold``, and asked again
            each time it has passed once more, in s. By default three time steps.

    Raises:
        ConfigError: If ``hold_after`` is not positive.
    """

    backend: Any
    clock: Clock = field(default_factory=RealClock)
    hold_after: float | None = None

    def __post_init__(self) -> None:
        if self.hold_after is not None:
            number = check_number(
                "hold_after", self.hold_after, positive=True, may_be_infinite=True
            )
            object.__setattr__(self, "hold_after", number)

    def time_until_hold(self, period: float) -> float:
        """Return ``hold_after`` in s, or its default for a time step in s."""
        return _HOLD_AFTER * period if self.hold_after is None else self.hold_after


class TickSchedule:
    """The ticks of N backends that are stepped together.

    Args:
        period: Time from one tick to the next, in s.
        clock: Tells the time.
        count: N.

    Attributes:
        misses: How many steps of this episode were late by more than a tenth of the period,
            shape (N,).
        worst: The largest lateness in this episode, in s, shape (N,).
    """

    def __init__(self, period: float, clock: Clock, count: int) -> None:
        self._period, self._clock = period, clock
        self._due = np.zeros(count)
        self.misses = np.zeros(count, np.int64)
        self.worst: FloatArray = np.zeros(count)

    def start(self, chosen: MaskArray) -> None:
        """Begin an episode of some backends; their first tick is one period from now."""
        self._due[chosen] = self._clock.time() + self._period
        self.misses[chosen] = 0
        self.worst[chosen] = 0.0

    def wait(self, chosen: MaskArray) -> None:
        """Wait for the next tick of some backends, at least one; return at once if it is over."""
        tick = float(self._due[chosen].max())
        self._clock.sleep(tick - self._clock.time())
        now = self._clock.time()
        tolerance = _TOLERANCE * self._period
        late = np.where(chosen, now - self._due, 0.0)
        self.misses += late > tolerance
        np.maximum(self.worst, late, out=self.worst)
        self._due[chosen] = (now if now > tick + tolerance else tick) + self._period
