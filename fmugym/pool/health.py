"""The counters of a pool for the work and the faults of each instance."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.pool.base import FloatArray, MaskArray, Pool
from fmugym.pool.spec import PoolSpec, ResetMethod
from fmugym.pool.tape import Effort, Judge, Recorder, Rehearsals, Tape

__all__ = [
    "HEALTH",
    "HEALTH_COUNTS",
    "Column",
    "CountedPool",
    "HealthArray",
    "fault_rates",
    "no_counts",
    "note",
]

HealthArray = npt.NDArray[np.int64]

HEALTH: Final = (
    "resets",
    "steps",
    "discards",
    "errors",
    "fatals",
    "not_finite",
    "retries",
    "replacements",
    "recyclings",
    "deaths",
)
"""The names of the counters, in the order of the columns and of ``native/pool.h``."""

HEALTH_COUNTS: Final = len(HEALTH) + 1
"""The number of columns of an array of counts; the last column has the last step's retries."""


class Column:
    """The index of each column."""

    RESETS, STEPS, DISCARDS, ERRORS, FATALS, NOT_FINITE = range(6)
    RETRIES, REPLACEMENTS, RECYCLINGS, DEATHS, RETRIED = range(6, HEALTH_COUNTS)


_FAULTS: Final = {
    Status.DISCARD: Column.DISCARDS,
    Status.ERROR: Column.ERRORS,
    Status.FATAL: Column.FATALS,
    Status.NOT_FINITE: Column.NOT_FINITE,
}


def no_counts(num_instances: int) -> HealthArray:
    """Make the counts of N instances, all zero."""
    return np.zeros((num_instances, HEALTH_COUNTS), np.int64)


def note(counts: HealthArray, status: int) -> int:
    """Count a status for its instance if it is a fault; return the status."""
    if status > Status.WARNING:
        column = _FAULTS.get(Status(status))
        if column is not None:
            counts[column] += 1
    return status


class CountedPool(Pool):
    """A pool that counts what its instances do.

    A subclass sets ``_spec``, and ``_counts`` of shape (N, HEALTH_COUNTS).
    """

    _spec: PoolSpec
    _counts: HealthArray
    _rehearsals: Rehearsals | None = None
    _recorder: Recorder | None = None

    @property
    def reset_method(self) -> ResetMethod:
        """See ``Pool.reset_method``."""
        return self._spec.reset_method

    def _count_steps(self) -> None:
        """Add the steps so far to the counts."""

    def _memory_growth(self) -> Any:
        """The growth of memory in bytes: one number for each instance, or one for all."""
        return 0

    def health(self) -> dict[str, HealthArray]:
        """See ``Pool.health``."""
        self._count_steps()
        columns = {name: self._counts[:, index].copy() for index, name in enumerate(HEALTH)}
        growth = np.full(len(self._counts), self._memory_growth(), np.int64)
        count = 0 if self._rehearsals is None else self._rehearsals.count
        rehearsals = np.full(len(self._counts), count, np.int64)
        return columns | {"memory_growth": growth, "rehearsals": rehearsals}

    # Recordings of episodes; the native pool makes its own.

    def rehearse_with(self, judge: Judge) -> None:
        """See ``Pool.rehearse_with``."""
        self._rehearsals = Rehearsals(self, judge)
        self.record(*self._rehearsals.next())

    def record(self, resets: int, steps: int) -> None:
        """Record an episode after so many more resets of the first instance.

        Args:
            resets: Of the first instance.
            steps: How many steps it has to do in all before.
        """
        self._recorder = Recorder() if self._recorder is None else self._recorder
        self._recorder.wait(resets, steps)

    def effort(self) -> Effort:
        """How much time the pool's calls take; only once ``rehearse_with`` was called."""
        self._count_steps()
        assert self._recorder is not None
        return self._recorder.effort(self._counts[:, Column.STEPS], self._one_by_one)

    @property
    def _one_by_one(self) -> int:
        """How many instances a call resets and steps one after the other."""
        return self.num_instances

    def _note_reset(
        self,
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray | None,
        seconds: float,
    ) -> None:
        """Tell the recorder of a reset, after it."""
        recorder = self._recorder
        if recorder is None:
            return
        recorder.note_reset(seconds)
        if not (mask is None or mask[0]):
            return
        tape = recorder.finish()
        if tape is not None:
            self._hand_over(tape)
        elif recorder.turn(int(self._counts[0, Column.STEPS])):
            if self.statuses[0] <= WARNING_CODE:
                recorder.begin(variables, values[:, 0], self.outputs[:, 0])
            else:
                recorder.drop()

    def _note_step(self, skip: MaskArray | None, seconds: float) -> None:
        """Tell the recorder of a step, after it; only while it records."""
        if self._recorder is None or (skip is not None and skip[0]):
            return
        self._recorder.note_step(seconds)
        tape = self._recorder.add(self.inputs[:, 0], self.outputs[:, 0], int(self.statuses[0]))
        if tape is not None:
            self._hand_over(tape)

    @property
    def _is_recording(self) -> bool:
        return self._recorder is not None and self._recorder.is_on

    def _drop_recording(self) -> None:
        if self._recorder is not None:
            self._recorder.drop()

    def _hand_over(self, tape: Tape) -> None:
        if self._rehearsals is not None:
            self._rehearsals.receive(tape)

    def forget_health(self) -> None:
        """See ``Pool.forget_health``."""
        self._count_steps()
        self._counts[:] = 0

    def note_fault(self, index: int) -> None:
        """See ``Pool.note_fault``."""
        self._counts[index, Column.NOT_FINITE] += 1

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """See ``Pool.info``: how often the last step was repeated, if steps may be repeated."""
        if not self._spec.fault_retries:
            return {}
        return {"retries": self._counts[:, Column.RETRIED].copy()}


def fault_rates(health: dict[str, HealthArray]) -> npt.NDArray[np.float64]:
    """The share of each instance's episodes that ended with a fault, shape (N,)."""
    kinds: Iterable[str] = ("discards", "errors", "fatals", "not_finite", "deaths")
    faults = sum((health[kind] for kind in kinds), np.zeros_like(health["resets"]))
    rates: npt.NDArray[np.float64] = np.minimum(1.0, faults / np.maximum(1, health["resets"]))
    return rates
