"""Trials that show whether an FMU begins each episode as a fresh instance does.

The reference is a fresh instance of a fresh copy of the FMU's library. One instance then plays
several episodes, and the reset method in question begins each of them. Every episode is compared
with the reference: after a short and after a long episode, twice, and with different start values.
The inputs move, because that often is the only way to see that a reset forgets something.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.errors import FMUGymError, LicenceError
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.pool.attendant import AttendedPool
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.patience import require_licence
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.trial.candidate import Candidate
from fmugym.trial.inputs import moving_inputs
from fmugym.trial.pools import trial_pool
from fmugym.trial.verdict import Grade

__all__ = ["Rehearsal", "Starts"]

_SHORT: Final = 3
"""The steps of a short episode."""

_RESTORED: Final = 2
"""The number of the first episode that begins with a restored state."""

_LONGEST: Final = 400
"""The most steps of a long episode."""

_LONG_SECONDS: Final = 0.1
"""The real time in seconds after which a long episode of a slow FMU ends."""

_SLOW_INITIALIZATION: Final = 2.0
"""The real time in seconds from which an initialization counts as slow."""

_AMPLITUDES: Final = (1.0, 0.1, 0.0)
"""How far inputs move, as fractions of their range; the smaller ones for FMUs that fail."""

_RELATIVE_TOLERANCE: Final = 1e-4
"""The solver tolerance if neither the config nor the FMU gives one."""

_NUDGE: Final = 0.01
"""How far equal start values of two episodes are moved apart, as a fraction."""

_PLAYED: Final = (Status.OK, Status.TERMINATED)

_SLACK: Final = 10.0
"""By how many tolerances two runs of a solver may differ."""


@dataclass(frozen=True)
class Starts:
    """Different start values of two episodes.

    Attributes:
        variables: The P variables that are set before initialization.
        values: Their values, shape (P, 2).
    """

    variables: tuple[Variable, ...] = ()
    values: tuple[tuple[float, float], ...] = ()

    def column(self, index: int) -> FloatArray:
        """The values of one episode, shape (P, 1)."""
        return np.array(self.values, np.float64).reshape(-1, 2)[:, index : index + 1]

    def apart(self) -> Starts:
        """The same start values, but Reals that are equal in both episodes are one percent apart.

        An attribute that is set later may change them, although the config does not.
        """
        pairs = zip(self.variables, self.values, strict=True)
        return replace(self, values=tuple(_apart(variable, *pair) for variable, pair in pairs))


def _apart(variable: Variable, first: float, second: float) -> tuple[float, float]:
    if first != second or variable.kind != "real":
        return first, second
    distance = _NUDGE * (abs(first) or abs(variable.nominal or 1.0))
    above, below = first + distance, first - distance
    return first, above if above <= variable.maximum or below < variable.minimum else below


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
        candidate: The FMU.
        spec: What to do at each reset and step.
        starts: The start values of two episodes.

    Attributes:
        noisy: The names of the outputs that two fresh instances give differently, as far as known.
        is_frugal: Whether fewer episodes are played, because initializations are slow or need
            licences.
        reason: The FMU's message if even a fresh instance cannot play an episode, otherwise "".
    """

    def __init__(self, candidate: Candidate, spec: PoolSpec, starts: Starts) -> None:
        self._candidate, self._starts = candidate, starts
        self._spec = replace(spec, num_observed=0, leak_limit=None, fault_retries=0)
        self.noisy: tuple[str, ...] = ()
        self.reason = ""
        self.is_frugal = spec.licence_wait > 0.0
        self._steps, self._inputs = 0, np.zeros((0, len(spec.inputs)))
        self._references: list[_Run] = []
        self._tolerances, self._knows_noise = np.full(len(spec.outputs), _tolerance_of(spec)), False
        self._find_reference()

    @property
    def possible(self) -> bool:
        """Whether a fresh instance can play an episode, so that there is a reference."""
        return bool(self._references)

    def _find_reference(self) -> None:
        """Play the reference with inputs that move as far as the FMU tolerates."""
        for amplitude in _AMPLITUDES:
            self._inputs = moving_inputs(self._spec, _LONGEST, amplitude)
            self._steps = _LONGEST
            first = self._play_fresh(0, measured=True)
            if first.status in _PLAYED:
                self._references = [first, self._play_with_other_starts()]
                return
            self.reason = first.failure

    def _play_with_other_starts(self) -> _Run:
        """Move equal start values apart, unless the FMU does not play with what comes out."""
        given, self._starts = self._starts, self._starts.apart()
        run = self._play_fresh(1)
        if run.status in _PLAYED or self._starts == given:
            return run
        self._starts = given
        return self._play_fresh(1)

    def _compare_fresh_instances(self) -> None:
        """Find out, when an episode first differs, whether fresh instances differ as well."""
        self._knows_noise = True
        again = self._play_fresh(0)
        if not _same(again, self._references[0]):
            noise = _difference(again.rows, self._references[0].rows)
            names = [variable.name for variable in self._spec.outputs]
            found = [name for name, own in zip(names, noise, strict=True) if own > 0.0]
            self.noisy = tuple(found or names)
            self._tolerances = np.maximum(self._tolerances, _SLACK * noise)

    def _play_fresh(self, start: int, *, measured: bool = False) -> _Run:
        pool = self._open(ResetMethod.RESET)
        try:
            return self._play(pool, start, self._steps, measured=measured)
        finally:
            pool.close()

    def _open(self, method: ResetMethod, components: tuple[ResetMethod, ...] = ()) -> AttendedPool:
        log = logging.getLogger(__name__)
        spec = replace(self._spec, reset_method=method, component_resets=components)
        return trial_pool(self._candidate.open(), spec, 1, log, private_libraries=spec.reloads)

    def _play(self, pool: Pool, start: int, steps: int, *, measured: bool = False) -> _Run:
        """Play one episode; a measured one determines how many steps a long episode has."""
        begin = time.perf_counter()
        outputs, statuses = pool.reset(self._starts.variables, self._starts.column(start))
        require_licence(pool)
        now = time.perf_counter()
        deadline = now + _LONG_SECONDS
        if measured and now - begin > _SLOW_INITIALIZATION:
            self.is_frugal = True
        rows = [outputs[:, 0].copy()]
        for row in self._inputs[:steps]:
            if statuses[0] > WARNING_CODE:
                break
            outputs, statuses = pool.step(row[:, None])
            rows.append(outputs[:, 0].copy())
            if measured and time.perf_counter() > deadline:
                self._steps = len(rows) - 1
                break
        if statuses[0] <= WARNING_CODE:
            return _Run(np.array(rows), Status.OK)
        return _Run(np.array(rows), int(statuses[0]), pool.failure(0))

    def grade(self, method: ResetMethod, components: tuple[ResetMethod, ...] = ()) -> Grade:
        """Play several episodes with one instance and compare each with a fresh one.

        Args:
            method: How the episodes begin.
            components: How each component of a system begins them; empty for ``method``.

        Returns:
            The worst grade of all episodes.
        """
        try:
            pool = self._open(method, components)
        except LicenceError:
            raise
        except FMUGymError:
            return Grade.FAILS
        try:
            is_system = self._candidate.plan is not None
            return self._worst_grade(pool, restores=is_system and method is ResetMethod.RESTORE)
        finally:
            pool.close()

    def _worst_grade(self, pool: AttendedPool, *, restores: bool = False) -> Grade:
        """Grade episodes.

        Args:
            pool: Plays them.
            restores: Whether it counts as wrong that the pool gives restores up. Of a system, the
                components that are not to blame can be restored all the same; of a single FMU, the
                initialization that takes the place of a restore is as good as any.
        """
        from fmugym import _native

        worst = Grade.BITWISE
        for number, (start, steps) in enumerate(self._episodes()):
            before = _native.initializations()
            run = self._play(pool, start, steps)
            is_new = _native.initializations() > before
            if restores and number == _RESTORED and is_new:
                return Grade.WRONG
            grade = self._compare(run, self._references[start].cut(steps))
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


def _tolerance_of(spec: PoolSpec) -> float:
    """By how much two runs of a solver may differ, as a fraction of the largest magnitude."""
    return _SLACK * (spec.tolerance or _RELATIVE_TOLERANCE)


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
