"""Episodes of fresh instances, the reference for episodes of other instances.

Each is played in a process of its own, with a fresh copy of the FMU's files. The inputs move,
because that often is the only way to see that something is kept or shared.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from fmugym.fmi.status import Status
from fmugym.pool.pool import FloatArray
from fmugym.pool.pool_spec import PoolSpec, ResetMethod
from fmugym.pool.trial.trial_episodes import Inputs, Run, Starts, Stretch, play
from fmugym.pool.trial.trial_workers import TriedPool, Workers
from fmugym.pool.trial.verdict import Finding, Grade

__all__ = ["AMPLITUDES", "BUDGET", "SMALL_BUDGET", "Budget", "Reference"]

BUDGET: Final = 0.3
SMALL_BUDGET: Final = 0.05
"""The seconds that the longest episode may take, also if nothing limits those of the task; see
``Budget``."""

_SLACK_OF_TIME: Final = 20.0
"""How many times as long it may take in real time, unless it is very short."""

_SURE: Final = 10
"""The steps of which the fastest one tells how slow an FMU is; the first one may load its data."""

_SLOW: Final = 0.02
"""The seconds that a slow step takes; other work on the machine delays each step by less, though
often by the 4 ms between two decisions of a scheduler."""

_LEAST: Final = 30
"""The least steps of the longest episode, unless all steps are slow."""

AMPLITUDES: Final = (1.0, 0.1, 0.0)
"""How far inputs move, as fractions of their range; the smaller ones for FMUs that fail."""

_RELATIVE_TOLERANCE: Final = 1e-4
"""The solver tolerance if neither the config nor the FMU gives one."""

_SLACK: Final = 10.0
"""By how many tolerances two runs of a solver may differ."""


class Budget:
    """The time for the longest episode; it begins after the first step.

    Args:
        seconds: How long it may take if all steps are as fast as the fastest one, which other work
            on the machine has not slowed down.

    Attributes:
        fastest: The real time of the fastest step, in seconds.
        spent: Whether it has ended the episode.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds, self.fastest, self.spent = seconds, math.inf, False
        self._begin = self._now = time.perf_counter()

    def is_reached(self, steps: int) -> bool:
        """Whether the time is over after so many steps; asked after each."""
        before, self._now = self._now, time.perf_counter()
        self._begin = self._now if steps == 1 else self._begin
        self.fastest = min(self.fastest, self._now - before)
        is_late = self._now - self._begin > _SLACK_OF_TIME * self._seconds
        is_long = steps * self.fastest > self._seconds
        least = _LEAST if self.fastest < _SLOW else 1 if is_late else _SURE
        self.spent = (is_late or is_long) and steps >= least
        return self.spent


class Reference:
    """Two episodes of fresh instances.

    Args:
        workers: The processes of the trial.
        spec: What to do at each reset and step.
        starts: The start values of both episodes.
        length: The most steps of an episode of the task; None if nothing limits them.

    Attributes:
        workers: As given.
        spec: As given; but with a blind start if the FMU can only be played so.
        starts: As given; but equal ones are apart if the FMU can be played so.
        inputs: Those of both episodes.
        runs: The two episodes; none before, or if a fresh instance cannot play them.
        steps: Their number of steps.
        tried_length: The most steps of an episode for which the trial holds; None if for any,
            because the FMU or the time ends a longer one.
        noisy: The names of the outputs that two fresh instances give differently, as far as known.
        step_seconds: The real time of the fastest step; infinite before.
        fails_in_reading: Whether even a fresh instance cannot play an episode, because its outputs
            cannot be read.
    """

    def __init__(
        self, workers: Workers, spec: PoolSpec, starts: Starts, length: int | None
    ) -> None:
        self.workers, self.spec, self.starts, self._length = workers, spec, starts, length
        self.inputs, self.runs = Inputs(spec, 0.0), list[Run]()
        self.steps, self.tried_length = 0, length
        self.noisy: tuple[str, ...] = ()
        self.step_seconds = math.inf
        self.fails_in_reading = False
        tolerance = _SLACK * (spec.tolerance or _RELATIVE_TOLERANCE)  # of the largest magnitude
        self._tolerances, self._knows_noise = np.full(len(spec.outputs), tolerance), False

    @property
    def possible(self) -> bool:
        """Whether a fresh instance can play an episode."""
        return bool(self.runs)

    # The episodes of fresh instances

    def find(self) -> None:
        """Play them, with inputs that move as far as the FMU tolerates.

        Raises:
            DeathError: If the process of a fresh instance does not survive that.
            LicenceError: If it gets no licence.
            FMULoadError: If it cannot be made.
        """
        given = self.spec
        for blind in (False, True):
            self.spec = replace(given, blind_start=blind)
            failure = self._find()
            self.fails_in_reading = "reading the outputs" in failure
            if not self.fails_in_reading:
                return
        self.spec = given

    def _find(self) -> str:
        """Play with inputs that move less and less; returns the failure that stays."""
        failed: list[tuple[Run, Inputs]] = []
        for amplitude in AMPLITUDES:
            self.inputs = Inputs(self.spec, amplitude)
            first, failure = self._measured()
            if first.played:
                return self._take(first)
            if len(first.rows) == 1:  # it has not been stepped
                return failure
            failed.append((first, self.inputs))
        longest, self.inputs = max(failed, key=lambda one: len(one[0].rows))
        steps = len(longest.rows) - 2
        return self._take(longest.cut(steps)) if steps else failure

    def _take(self, first: Run) -> str:
        """Take an episode of a fresh instance for episode 0, and play episode 1."""
        self.steps = len(first.rows) - 1
        self.runs = [first, self._other(first)]
        return ""

    def _measured(self) -> tuple[Run, str]:
        """Play episode 0 as long as the task lasts or the time suffices; and why it failed."""
        with self._fresh() as pool:
            budget = Budget(SMALL_BUDGET if self._length is None else BUDGET)
            stretch = Stretch((0,), self._length or sys.maxsize)
            run = play(pool, self.starts, self.inputs, [stretch], budget)[0][0]
            failure = "" if run.played else pool.failure(0)
        self.step_seconds = budget.fastest
        is_longest = run.status != Status.OK or (budget.spent and self._length is not None)
        self.tried_length = None if is_longest else self._length or len(run.rows) - 1
        return run, failure

    def _other(self, first: Run) -> Run:
        """Play episode 1; equal start values are moved apart, unless the FMU does not play so."""
        given, self.starts = self.starts, self.starts.apart()
        if not self.spec.inputs and all(one == other for one, other in self.starts.values):
            return replace(first, episode=1)
        run = self.play_fresh(1)
        if run.played or self.starts == given:
            return run
        self.starts = given
        return self.play_fresh(1)

    @contextmanager
    def _fresh(self) -> Iterator[TriedPool]:
        with self.open("the episode of a fresh instance") as pool:
            yield pool

    def step_once(self) -> None:
        """Let a fresh instance do one step, and free it; errors are those of ``find``."""
        with self.open("the first step") as pool:
            self.play(pool, 0, 1)

    def play_fresh(self, episode: int) -> Run:
        """Play an episode with a fresh instance."""
        with self._fresh() as pool:
            return self.play(pool, episode, self.steps)

    def play(self, pool: TriedPool, episode: int, steps: int) -> Run:
        """Play an episode with the only instance of a pool."""
        return play(pool, self.starts, self.inputs, [Stretch((episode,), steps)])[0][0]

    @contextmanager
    def open(
        self,
        stage: str,
        method: ResetMethod = ResetMethod.RESET,
        components: tuple[ResetMethod, ...] = (),
        num_instances: int = 1,
        *,
        private_libraries: bool = False,
    ) -> Iterator[TriedPool]:
        """Make instances in a new process; see ``Workers.pool``.

        Args:
            stage: The part of the trial.
            method: How episodes begin.
            components: How each component of a system begins them; empty for ``method``.
            num_instances: N.
            private_libraries: Whether each instance has a copy of the library.
        """
        spec = replace(self.spec, reset_method=method, component_resets=components)
        private = private_libraries or spec.reloads
        with self.workers.pool(stage, spec, num_instances, private_libraries=private) as pool:
            yield pool

    # Comparisons

    def is_as_fresh(self, run: Run) -> bool:
        """Whether a fresh instance gives the same, bit by bit."""
        return run.equals(self._expected(run))

    def _expected(self, run: Run) -> Run:
        return self.runs[run.episode].cut(len(run.rows) - 1)

    def worst(self, runs: Sequence[Run]) -> Finding:
        """Compare episodes with episodes of fresh instances; return the worst finding."""
        worst, before = Finding(Grade.BITWISE, ""), 0
        for number, run in enumerate(runs):
            grade = self._grade(run)
            if grade is not Grade.BITWISE:
                where = f"in the episode after one of {before} steps, " if number else ""
                found = Finding(grade, where + self.difference(run, self._expected(run)))
                if grade is not Grade.TOLERANCE:
                    return found
                worst = found
            before = len(run.rows) - 1
        return worst

    def _grade(self, run: Run) -> Grade:
        expected = self._expected(run)
        if run.status != Status.OK and run.status != expected.status:
            return Grade.FAILS
        if run.equals(expected):
            return Grade.BITWISE
        self.find_noise()
        close = len(run.rows) == len(expected.rows) and run.status == expected.status
        whole = self.runs[run.episode].rows
        if close and np.all(_difference(run.rows, expected.rows, whole) <= self._tolerances):
            return Grade.TOLERANCE
        return Grade.WRONG

    def compare(self, runs: Sequence[Run], others: Sequence[Run]) -> Finding:
        """Compare episodes with others in the outputs that fresh instances give alike."""
        if len(runs) != len(others):
            return Finding(Grade.FAILS, "the FMU refuses, or its process dies")
        for run, other in zip(runs, others, strict=True):
            if self._differ(run, other):
                return Finding(Grade.WRONG, self.difference(run, other))
        return Finding(Grade.BITWISE, "")

    def _differ(self, one: Run, other: Run) -> bool:
        if one.equals(other):
            return False
        self.find_noise()
        return not one.equals(other, self._steady)

    @property
    def _steady(self) -> npt.NDArray[np.bool_]:
        """Mask of outputs without noise; all if all are noisy."""
        steady = np.array([v.name not in self.noisy for v in self.spec.outputs], np.bool_)
        return steady | (not steady.any())

    def difference(self, run: Run, expected: Run) -> str:
        """Say where a run first differs from another one."""
        length = min(len(run.rows), len(expected.rows))
        one, other = run.rows[:length], expected.rows[:length]
        rows, columns = np.nonzero((one != other) & ~(np.isnan(one) & np.isnan(other)))
        if not rows.size:
            return f"it ends after {len(run.rows) - 1} steps instead of {len(expected.rows) - 1}"
        row, column = rows[0], columns[0]
        when = f"after step {row}" if row else "at the start"
        values = f"{one[row, column]:g} instead of {other[row, column]:g}"
        return f"{self.spec.outputs[column].name} is {values} {when}"

    def find_noise(self) -> None:
        """Find out, when an episode first differs, whether fresh instances differ as well."""
        if self._knows_noise:
            return
        self._knows_noise = True
        first = self.runs[0]
        again = self.play_fresh(0)
        if again.equals(first):
            return
        noise = _difference(again.rows, first.rows)
        names = [variable.name for variable in self.spec.outputs]
        found = [name for name, own in zip(names, noise, strict=True) if own > 0.0]
        self.noisy = tuple(found or names)
        for run in self._play_afresh_in_one_process():
            noise = np.where(noise > 0.0, np.maximum(noise, _difference(run.rows, first.rows)), 0.0)
        self._tolerances = np.maximum(self._tolerances, _SLACK * noise)

    def _play_afresh_in_one_process(self) -> list[Run]:
        """Play episode 0 twice; differing outputs may depend on a process's age."""
        reloads = self.workers.can_copy_libraries
        method = ResetMethod.LIBRARY if reloads else ResetMethod.INSTANCE
        with self.open("the search for noise", method) as pool:
            return [self.play(pool, 0, self.steps) for _ in range(2)]


def _difference(one: FloatArray, other: FloatArray, whole: FloatArray | None = None) -> FloatArray:
    """The largest difference of each output, as a fraction of its largest magnitude.

    Args:
        one: A row of outputs for each step.
        other: The same of another run; the rows that one of them lacks are left out.
        whole: The rows of a longer run that count for the magnitude, too.
    """
    length = min(len(one), len(other))
    a, b = one[:length], other[:length]
    if a.size == 0:
        return np.zeros(one.shape[1])
    rows = [a, b] if whole is None else [a, b, whole]
    scale = np.abs(np.concatenate(rows)).max(axis=0)
    with np.errstate(all="ignore"):
        relative: FloatArray = np.abs(a - b).max(axis=0) / np.where(scale == 0.0, 1.0, scale)
    return np.where(np.isnan(relative), np.inf, relative)
