"""The arrays of a pool, with counters for the work and the faults of each instance."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.fmi.status import Status
from fmugym.pool.pool import FloatArray, MaskArray, Pool, StatusArray
from fmugym.pool.pool_spec import PoolSpec, ResetMethod

__all__ = [
    "HEALTH",
    "HEALTH_COUNTS",
    "Arrays",
    "Column",
    "CountedPool",
    "HealthArray",
    "fault_rates",
    "layout_of",
    "new_arrays",
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
"""The names of the counters, in the order of the columns and of ``native/pool/pool.h``."""

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


class Arrays(NamedTuple):
    """The arrays of a pool; see ``Pool``.

    Attributes:
        mask: The instances that a step leaves out, or that a start starts, shape (N,).
        counts: What each instance does, shape (N, HEALTH_COUNTS).
    """

    inputs: FloatArray
    outputs: FloatArray
    observations: npt.NDArray[np.float32]
    statuses: StatusArray
    mask: MaskArray
    counts: HealthArray


def layout_of(spec: PoolSpec, count: int) -> list[tuple[tuple[int, ...], Any]]:
    """The shape and type of each of the arrays of N instances."""
    return [
        ((len(spec.inputs), count), np.float64),
        ((len(spec.outputs), count), np.float64),
        ((count, spec.num_observed), np.float32),
        ((count,), np.int8),
        ((count,), np.bool_),
        ((count, HEALTH_COUNTS), np.int64),
    ]


def new_arrays(spec: PoolSpec, count: int) -> Arrays:
    """Make the arrays of N instances, all zero."""
    return Arrays(*(np.zeros(*row) for row in layout_of(spec, count)))


def note(counts: HealthArray, status: int) -> int:
    """Count a status for its instance if it is a fault; return the status."""
    if status > Status.WARNING:
        column = _FAULTS.get(Status(status))
        if column is not None:
            counts[column] += 1
    return status


class CountedPool(Pool):
    """Pool that counts events of its instances.

    A subclass sets ``_spec``, and gets its arrays by ``_use``.
    """

    _spec: PoolSpec
    _counts: HealthArray

    def _use(self, arrays: Arrays) -> None:
        """Let these be the arrays of the pool."""
        self.inputs, self.outputs, self.observations = arrays[:3]
        self.statuses, self._counts = arrays.statuses, arrays.counts
        self.num_instances = len(arrays.statuses)

    def _as_mask(self, mask: MaskArray | None) -> MaskArray:
        return np.ones(self.num_instances, np.bool_) if mask is None else np.asarray(mask, np.bool_)

    @property
    def reset_method(self) -> ResetMethod:
        """See ``Pool.reset_method``."""
        return self._spec.reset_method

    def _count_steps(self) -> None:
        """Add the steps so far to the counts."""

    def health(self) -> dict[str, HealthArray]:
        """See ``Pool.health``."""
        self._count_steps()
        return {name: self._counts[:, index].copy() for index, name in enumerate(HEALTH)}

    def forget_health(self) -> None:
        """See ``Pool.forget_health``."""
        self._count_steps()
        self._counts[:] = 0

    def note_fault(self, index: int) -> None:
        """See ``Pool.note_fault``."""
        self._counts[index, Column.NOT_FINITE] += 1

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """See ``Pool.info``: the repetitions of the last step, if steps may be repeated."""
        if not self._spec.fault_retries:
            return {}
        return {"retries": self._counts[:, Column.RETRIED].copy()}


def fault_rates(health: dict[str, HealthArray]) -> npt.NDArray[np.float64]:
    """The share of each instance's episodes that ended with a fault, shape (N,)."""
    kinds = "discards", "errors", "fatals", "not_finite", "deaths"
    faults = np.sum([health[kind] for kind in kinds], axis=0)
    rates: npt.NDArray[np.float64] = np.minimum(1.0, faults / np.maximum(1, health["resets"]))
    return rates
