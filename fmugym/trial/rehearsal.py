"""Trials that show whether an FMU begins each episode as a fresh instance does.

The reference is a fresh instance of a fresh copy of the FMU's library. One instance then plays
several episodes, and the reset method in question begins each of them. Every episode is compared
with the reference: after a short and after a long episode, twice, and with different start values.
The inputs move, because that often is the only way to see that a reset forgets something.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.pool.base import FloatArray
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.inputs import inputs_of_two
from fmugym.trial.subject import Subject, TriedPool
from fmugym.trial.trial_episodes import Starts, start, steps
from fmugym.trial.verdict import Grade

__all__ = ["Rehearsal"]

_SHORT: Final = 3
"""The steps of a short episode."""

_MIDDLE: Final = 30
"""The most steps of an episode beside another instance, and the least of a long one, unless steps
are slow."""

_RESTORED: Final = 2
"""The number of the first episode that begins with a restored state."""

_LONGEST: Final = 200
"""The most steps of a long episode."""

_SURE: Final = 10
"""The steps of which the fastest one tells how slow an FMU is; the first one may load its data."""

_LONG_SECONDS: Final = 0.1
"""How long a long episode of a slow FMU takes in seconds, if all steps are as fast as the fastest
one, which other work on the machine has not slowed down."""

_LONGEST_SECONDS: Final = 1.0
"""The real time in seconds after which it ends, if it is not shorter than ``_MIDDLE``."""

_SLOW_INITIALIZATION: Final = 2.0
"""The real time in seconds from which an initialization counts as slow."""

_AMPLITUDES: Final = (1.0, 0.1, 0.0)
"""How far inputs move, as fractions of their range; the smaller ones for FMUs that fail."""

_RELATIVE_TOLERANCE: Final = 1e-4
"""The solver tolerance if neither the config nor the FMU gives one."""

_PLAYED: Final = (Status.OK, Status.TERMINATED)

_REHEARSED: Final = {
    ResetMethod.RESTORE: "state restores",
    ResetMethod.RESET: "resets",
    ResetMethod.INSTANCE: "new instances",
    ResetMethod.LIBRARY: "libraries loaded anew",
}
"""The reset methods, for messages."""

_SLACK: Final = 10.0
"""By how many tolerances two runs of a solver may differ."""


@dataclass(frozen=True)
class _Run:
    """One episode: a row of outputs for its start and for each step, and how it ended.

    A step with a warning counts as one without.
    """

    rows: FloatArray
    status: int
    failure: str = ""

    def cut(self, steps: int) -> _Run:
        """The same episode, stopped after some steps."""
        if steps + 1 > len(self.rows):
            return self
        return _Run(self.rows[: steps + 1], Status.OK)


class Rehearsal:
    """Plays episodes of one FMU with different reset methods.

    Args:
        subject: The FMU.
        spec: What to do at each reset and step.
        starts: The start values of two episodes.

    Attributes:
        subject: As given.
        spec: As given; but with a blind start if the FMU can only be played so.
        starts: As given; but equal ones are apart if the FMU can be played so.
        noisy: The names of the outputs that two fresh instances give differently, as far as known.
        step_seconds: The real time of the fastest step of the reference; infinite before.
        is_frugal: Whether fewer episodes are played, because initializations are slow or need
            licences.
        fails_in_reading: Whether even a fresh instance cannot play an episode, because its outputs
            cannot be read.
    """

    def __init__(self, subject: Subject, spec: PoolSpec, starts: Starts) -> None:
        self.subject, self.spec, self.starts = subject, spec, starts
        self.noisy: tuple[str, ...] = ()
        self.fails_in_reading = False
        self.is_frugal = spec.licence_wait > 0.0
        self.step_seconds = math.inf
        self._steps, self._inputs = 0, np.zeros((0, len(spec.inputs), 2))
        self._references: list[_Run] = []
        tolerance = _SLACK * (spec.tolerance or _RELATIVE_TOLERANCE)  # of the largest magnitude
        self._tolerances, self._knows_noise = np.full(len(spec.outputs), tolerance), False

    @property
    def possible(self) -> bool:
        """Whether a fresh instance can play an episode, so that there is a reference."""
        return bool(self._references)

    def find_reference(self) -> None:
        """Play the reference with inputs that move as far as the FMU tolerates.

        Raises:
            DeathError: If the process of a fresh instance does not survive that.
            LicenceError: If it gets no licence.
            FMULoadError: If it cannot be made.
        """
        given = self.spec
        for blind in (False, True):
            self.spec = replace(given, blind_start=blind)
            failure = self._find_reference()
            self.fails_in_reading = "reading the outputs" in failure
            if not self.fails_in_reading:
                return
        self.spec = given

    def _find_reference(self) -> str:
        """Play with inputs that move less and less; returns the failure that stays."""
        for amplitude in _AMPLITUDES:
            self._inputs = inputs_of_two(self.spec, _LONGEST, amplitude)
            self._steps = _LONGEST
            first = self._play_fresh(0, measured=True)
            if first.status in _PLAYED:
                self._references = [first, self._play_with_other_starts(first)]
                return ""
            if len(first.rows) == 1:  # it has not been stepped
                break
        return first.failure

    def step_once(self) -> None:
        """Let a fresh instance do one step, and free it; it raises what ``find_reference`` does."""
        with self._open("the first step", ResetMethod.RESET) as pool:
            self._play(pool, 0, 1)

    def _play_with_other_starts(self, first: _Run) -> _Run:
        """Move equal start values apart, unless the FMU does not play with what comes out.

        Args:
            first: The episode with the first start values.
        """
        given, self.starts = self.starts, self.starts.apart()
        if all(one == other for one, other in self.starts.values):
            return first
        run = self._play_fresh(1)
        if run.status in _PLAYED or self.starts == given:
            return run
        self.starts = given
        return self._play_fresh(1)

    def _compare_fresh_instances(self) -> None:
        """Find out, when an episode first differs, whether fresh instances differ as well."""
        self._knows_noise = True
        first = self._references[0]
        again = self._play_fresh(0)
        if _same(again, first):
            return
        noise = _difference(again.rows, first.rows)
        names = [variable.name for variable in self.spec.outputs]
        found = [name for name, own in zip(names, noise, strict=True) if own > 0.0]
        self.noisy = tuple(found or names)
        for run in self._play_afresh_in_one_process():
            noise = np.where(noise > 0.0, np.maximum(noise, _difference(run.rows, first.rows)), 0.0)
        self._tolerances = np.maximum(self._tolerances, _SLACK * noise)

    def _play_afresh_in_one_process(self) -> list[_Run]:
        """Play the first episode twice; what differs each time may depend on a process's age."""
        reloads = self.subject.can_copy_libraries
        method = ResetMethod.LIBRARY if reloads else ResetMethod.INSTANCE
        with self._open("the search for noise", method) as pool:
            return [self._play(pool, 0, self._steps) for _ in range(2)]

    def _play_fresh(self, index: int, *, measured: bool = False) -> _Run:
        with self._open("the episode of a fresh instance", ResetMethod.RESET) as pool:
            return self._play(pool, index, self._steps, measured=measured)

    def _open(
        self,
        stage: str,
        method: ResetMethod,
        components: tuple[ResetMethod, ...] = (),
        num_instances: int = 1,
        private_libraries: bool = False,
    ) -> AbstractContextManager[TriedPool]:
        spec = replace(self.spec, reset_method=method, component_resets=components)
        private = private_libraries or spec.reloads
        return self.subject.pool(stage, spec, num_instances, private_libraries=private)

    def _play(self, pool: TriedPool, index: int, count: int, *, measured: bool = False) -> _Run:
        """Play one episode; a measured one determines how many steps a long episode has.

        A second instance gets other inputs and start values.
        """
        begin, instances = time.perf_counter(), range(pool.num_instances)
        rows = [start(pool, self.starts, *[index ^ i for i in instances])[:, 0]]
        now = time.perf_counter()
        self.is_frugal |= measured and now - begin > _SLOW_INITIALIZATION
        deadline, fastest = now + _LONGEST_SECONDS, math.inf
        for outputs in steps(pool, self._inputs[:count, :, instances]):
            rows.append(outputs[:, 0])
            before, now = now, time.perf_counter()
            fastest = min(fastest, now - before)
            is_late, is_slow = now > deadline, len(rows) * fastest > _LONG_SECONDS
            least = _MIDDLE if not is_slow else 0 if is_late else _SURE
            if measured and (is_late or is_slow) and len(rows) > least:
                self._steps = len(rows) - 1
                break
        if measured:
            self.step_seconds = fastest
        status = int(pool.statuses[0])
        if status <= WARNING_CODE:
            return _Run(np.array(rows), Status.OK)
        return _Run(np.array(rows), status, pool.failure(0))

    def grade(self, method: ResetMethod, components: tuple[ResetMethod, ...] = ()) -> Grade:
        """Play several episodes with one instance and compare each with a fresh one.

        Args:
            method: How the episodes begin.
            components: How each component of a system begins them; empty for ``method``.

        Returns:
            The worst grade of all episodes.
        """
        stage = f"the rehearsal of {_REHEARSED[method]}"
        if components:
            stage = f"the rehearsal of resets by component ({', '.join(components)})"
        is_system = bool(self.subject.fmu.description.components)

        def worst_grade() -> Grade:
            with self._open(stage, method, components) as pool:
                return self._worst_grade(pool, restores=is_system and method is ResetMethod.RESTORE)

        return self.subject.attempt(worst_grade, refused=Grade.FAILS, died=Grade.FAILS)

    def is_disturbed(
        self,
        method: ResetMethod,
        components: tuple[ResetMethod, ...],
        *,
        private_libraries: bool = False,
    ) -> bool:
        """Compare an instance alone with one beside another that gets other values.

        There are several episodes, since an instance may spoil the saved states of another. FMUs
        may still share things outside their library: files, other libraries, licences.

        Args:
            method: As for ``grade``.
            components: As for ``grade``.
            private_libraries: Whether each instance has a copy of the library.
        """
        play = partial(self._play_beside, method, components, private_libraries)

        def compare() -> bool:
            beside = play(2)
            if beside and all(map(self._is_as_fresh, beside)):
                return False
            alone = play(1)  # it may begin its later episodes in other ways than a fresh one
            return len(alone) != len(beside) or any(map(self._differ, alone, beside))

        return self.subject.attempt(compare, refused=False, died=True)

    def _play_beside(
        self,
        method: ResetMethod,
        components: tuple[ResetMethod, ...],
        private_libraries: bool,
        num_instances: int,
    ) -> list[_Run]:
        """Play three episodes; none if the process dies, or the FMU refuses."""
        what = "copy of the library" if private_libraries else "instance"
        stage = f"the comparison with a second {what}"

        def play() -> list[_Run]:
            with self._open(stage, method, components, num_instances, private_libraries) as pool:
                lengths = (min(_MIDDLE, self._steps), _SHORT, _SHORT)
                return [self._play(pool, 0, length) for length in lengths]

        return self.subject.attempt(play, refused=[], died=[])

    def _is_as_fresh(self, run: _Run) -> bool:
        return _same(run, self._references[0].cut(len(run.rows) - 1))

    def _differ(self, one: _Run, other: _Run) -> bool:
        """Whether two runs differ in an output that fresh instances give alike."""
        if _same(one, other):
            return False
        if not self._knows_noise:
            self._compare_fresh_instances()
        steady = [variable.name not in self.noisy for variable in self.spec.outputs]
        kept = np.array(steady) | (not any(steady))
        same = one.rows[:, kept].tobytes() == other.rows[:, kept].tobytes()
        return not same or one.status != other.status

    def _worst_grade(self, pool: TriedPool, *, restores: bool) -> Grade:
        """Grade episodes.

        Args:
            pool: Plays them.
            restores: Whether it counts as wrong that the pool gives restores up. Of a system, the
                components that are not to blame can be restored all the same; of a single FMU, the
                initialization that takes the place of a restore is as good as any.
        """
        worst = Grade.BITWISE
        for number, (index, count) in enumerate(self._episodes()):
            before = pool.initializations
            run = self._play(pool, index, count)
            is_new = pool.initializations > before
            if restores and number == _RESTORED and is_new:
                return Grade.WRONG
            grade = self._compare(run, self._references[index].cut(count))
            if grade in (Grade.WRONG, Grade.FAILS):
                return grade
            worst = Grade.TOLERANCE if Grade.TOLERANCE in (grade, worst) else worst
        return worst

    def _episodes(self) -> Sequence[tuple[int, int]]:
        """The start values and numbers of steps; each kind follows a short and a long episode.

        If initializations are precious, the first start values do not come back after the others.
        """
        short, long = min(_SHORT, self._steps), self._steps
        if self.is_frugal:
            return ((0, short), (0, long), (0, short), (1, long))
        return ((0, short), (0, long), (0, long), (1, short), (0, short), (0, long), (1, long))

    def _compare(self, run: _Run, reference: _Run) -> Grade:
        if run.status != Status.OK and run.status != reference.status:
            return Grade.FAILS
        if _same(run, reference):
            return Grade.BITWISE
        if not self._knows_noise:
            self._compare_fresh_instances()
        close = len(run.rows) == len(reference.rows) and run.status == reference.status
        if close and np.all(_difference(run.rows, reference.rows) <= self._tolerances):
            return Grade.TOLERANCE
        return Grade.WRONG


def _same(one: _Run, other: _Run) -> bool:
    return one.rows.tobytes() == other.rows.tobytes() and one.status == other.status


def _difference(one: FloatArray, other: FloatArray) -> FloatArray:
    """The largest difference of each output, as a fraction of its largest magnitude.

    Args:
        one: A row of outputs for each step.
        other: The same of another run; the rows that one of them lacks are left out.
    """
    length = min(len(one), len(other))
    a, b = one[:length], other[:length]
    if a.size == 0:
        return np.zeros(one.shape[1])
    scale = np.maximum(np.abs(a).max(axis=0), np.abs(b).max(axis=0))
    with np.errstate(all="ignore"):
        relative: FloatArray = np.abs(a - b).max(axis=0) / np.where(scale == 0.0, 1.0, scale)
    return np.where(np.isnan(relative), np.inf, relative)
