"""Episodes recorded in training, so that a fresh instance can play them again.

The trial of an FMU shows how its episodes have to begin, but only for the inputs and start values
of the trial. So a pool now and then records an episode of its first instance, and somebody else
plays it on a spare instance and compares. This may cost a hundredth of the time that the pool has
spent so far, so it is put off until this time is earned. A rehearsal that finds nothing changes
nothing, so equal seeds give equal results whenever it happens.
"""

from __future__ import annotations

import math
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.fmi.status import Status
from fmugym.pool.spec import ResetMethod

__all__ = ["TAPE_ROWS", "Effort", "Judge", "Recorder", "Rehearsals", "Tape"]

TAPE_ROWS: Final = 64
"""The most steps of a recording; ``native/tape.h`` has the same number."""

_FIRST_RESETS: Final = 1024
_FIRST_STEPS: Final = 2**18
_FACTOR: Final = 4
_LONGEST: Final = 4
"""After so many, the distance from one rehearsal to the next stays the same."""

_SHARE: Final = 0.01
"""The largest part of the pool's time that rehearsals may take."""

_FIRST_COST: Final = 0.5
"""The time in seconds that the first rehearsal may take besides the FMU's own: it may have to start
the process that starts workers."""

_LONGEST_DELAY: Final = 4.0
"""A rehearsal that is put off is considered again after so many times as many steps at most."""

Array = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Tape:
    """A recorded episode.

    Attributes:
        variables: The P variables that were set before initialization.
        starts: Their values, shape (P,).
        first_outputs: The outputs before the first step, shape (k,).
        inputs: Shape (steps, k_in).
        outputs: Those after each step, shape (steps, k).
        statuses: Shape (steps,).
    """

    variables: tuple[Variable, ...]
    starts: Array
    first_outputs: Array
    inputs: Array
    outputs: Array
    statuses: Array


Judge = Callable[[Tape, Callable[[ResetMethod], bool]], bool]
"""Takes a recording, and a function that lets the pool's episodes begin in another way and returns
whether the pool can do that. Returns whether to go on recording."""


@dataclass(frozen=True)
class Effort:
    """How much time the calls of a pool take.

    Attributes:
        total: Of all resets and steps so far, in seconds of one processor; rather too small.
        episode: Of the longest recording on a fresh instance, in seconds; rather too large.
        steps: The steps of the first instance so far.
    """

    total: float
    episode: float
    steps: int


class _Recording(Protocol):
    """A pool that records."""

    num_instances: int

    def begin_by(self, method: ResetMethod) -> bool:
        """See ``Pool.begin_by``."""
        ...

    def record(self, resets: int, steps: int) -> None:
        """See ``CountedPool.record``."""
        ...

    def effort(self) -> Effort:
        """See ``CountedPool.effort``."""
        ...


class Rehearsals:
    """Decides when a pool records, and passes on what it has recorded.

    Args:
        pool: The pool; a reference to it would keep it alive.
        judge: Gets the recordings.
        clock: Gives the time in seconds.

    Attributes:
        count: The number of rehearsals so far.
    """

    def __init__(
        self, pool: _Recording, judge: Judge, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._pool = weakref.ref(pool)
        self._num_instances = pool.num_instances
        self._judge, self._clock = judge, clock
        self.count = 0
        self._steps = 0
        self._spent = 0.0
        self._last_cost = _FIRST_COST

    def next(self) -> tuple[int, int]:
        """When to record next.

        Returns:
            How many more resets the first instance does before, and how many steps in all.
        """
        distance = _FACTOR ** min(self.count, _LONGEST)
        self._steps += distance * _FIRST_STEPS
        resets = distance * _FIRST_RESETS
        return -(-resets // self._num_instances), -(-self._steps // self._num_instances)

    def receive(self, tape: Tape) -> None:
        """Let a recording be judged if its cost is earned, and wait for the next one."""
        pool = self._pool()
        if pool is None:
            return
        effort = pool.effort()
        needed = self._needed(effort)
        if effort.total < needed:
            ratio = needed / effort.total if effort.total else math.inf
            pool.record(1, math.ceil(min(ratio, _LONGEST_DELAY) * effort.steps) + 1)
        elif self._judge_timed(tape, pool):
            pool.record(*self.next())

    def _needed(self, effort: Effort) -> float:
        """The time in seconds that must be spent before the next rehearsal.

        An episode is played twice if the first comparison fails.
        """
        return (self._spent + self._last_cost + 2.0 * effort.episode) / _SHARE

    def _judge_timed(self, tape: Tape, pool: _Recording) -> bool:
        self.count += 1
        began = self._clock()
        try:
            return self._judge(tape, pool.begin_by)
        finally:
            self._last_cost = self._clock() - began
            self._spent += self._last_cost


class Recorder:
    """The recorder of pools in Python; ``native/tape.c`` does the same.

    Attributes:
        is_on: Whether an episode is being recorded.
        is_waiting: Whether one will be.
    """

    def __init__(self) -> None:
        self.is_on = self.is_waiting = False
        self._resets = self._due_resets = self._due_steps = 0
        self._rows: list[tuple[Array, Array, int]] = []
        self._start: tuple[tuple[Variable, ...], Array, Array] = ((), np.zeros(0), np.zeros(0))
        self._seconds_of_resets = self._first_reset = 0.0
        self._quickest_step = math.inf

    def note_reset(self, seconds: float) -> None:
        """Note the time of a call that has reset any instances."""
        self._first_reset = self._first_reset or seconds
        self._seconds_of_resets += seconds

    def note_step(self, seconds: float) -> None:
        """Note the time of a call that has stepped instances while an episode is recorded."""
        self._quickest_step = min(self._quickest_step, seconds)

    def effort(self, steps: Array, one_by_one: int) -> Effort:
        """See ``CountedPool.effort``.

        Args:
            steps: Those of each instance so far.
            one_by_one: How many instances a call resets and steps one after the other.
        """
        a_step = self._quickest_step if math.isfinite(self._quickest_step) else 0.0
        return Effort(
            total=self._seconds_of_resets + int(steps.max()) * a_step,
            episode=(self._first_reset + TAPE_ROWS * a_step) / one_by_one,
            steps=int(steps[0]),
        )

    def wait(self, resets: int, steps: int) -> None:
        """Record after so many more resets, and so many steps in all."""
        self.is_on, self.is_waiting = False, True
        self._resets, self._due_resets, self._due_steps = 0, resets, steps

    def turn(self, steps: int) -> bool:
        """Note a reset of the first instance, after so many steps in all.

        Returns:
            Whether to begin a recording.
        """
        self._resets += 1
        due = self._resets >= self._due_resets and steps >= self._due_steps
        return self.is_on or (self.is_waiting and due)

    def begin(self, variables: tuple[Variable, ...], starts: Array, outputs: Array) -> None:
        """Begin a recording after a reset that went well."""
        self.is_on, self.is_waiting, self._rows = True, False, []
        self._start = variables, np.array(starts, np.float64), outputs.copy()

    def add(self, inputs: Array, outputs: Array, status: int) -> Tape | None:
        """Note a step of the first instance; returns the recording once it is long enough."""
        if self._rows and self._rows[-1][2] > Status.WARNING:  # the episode had ended before
            return None
        self._rows.append((inputs.copy(), outputs.copy(), status))
        return self.finish() if len(self._rows) == TAPE_ROWS else None

    def finish(self) -> Tape | None:
        """End a recording before a reset; None if it has no step."""
        if not self.is_on or not self._rows:
            return None
        self.is_on = False
        inputs, outputs, statuses = zip(*self._rows, strict=True)
        return Tape(*self._start, np.array(inputs), np.array(outputs), np.array(statuses, np.int8))

    def drop(self) -> None:
        """Give up a recording, because the episode was left in another way than by a reset."""
        if self.is_on:
            self.is_on, self.is_waiting = False, True
