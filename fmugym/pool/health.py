"""What is counted of each instance of a pool: its work and its faults."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.fmi.status import Status
from fmugym.pool.base import Pool
from fmugym.pool.spec import PoolSpec, ResetMethod

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
"""The names of the counts, in the order of the columns; ``native/pool.h`` has the same order."""

HEALTH_COUNTS: Final = len(HEALTH) + 1
"""Columns of an array of counts; the last one has the retries of the last step."""


class Column:
    """The indices of the columns."""

    RESETS, STEPS, DISCARDS, ERRORS, FATALS, NOT_FINITE = range(6)
    RETRIES, REPLACEMENTS, RECYCLINGS, DEATHS, RETRIED = range(6, HEALTH_COUNTS)


_FAULTS: Final = {
    Status.DISCARD: Column.DISCARDS,
    Status.ERROR: Column.ERRORS,
    Status.FATAL: Column.FATALS,
    Status.NOT_FINITE: Column.NOT_FINITE,
}


def no_counts(num_instances: int) -> HealthArray:
    """Counts of N instances of which nothing has been counted yet."""
    return np.zeros((num_instances, HEALTH_COUNTS), np.int64)


def note(counts: HealthArray, status: int) -> int:
    """Count a status of one instance, whose counts these are, if it is a fault; returns it."""
    if status > Status.WARNING:
        column = _FAULTS.get(Status(status))
        if column is not None:
            counts[column] += 1
    return status


class CountedPool(Pool):
    """A pool that counts what its instances do.

    A subclass has ``_spec``, and ``_counts`` of shape (N, HEALTH_COUNTS).
    """

    _spec: PoolSpec
    _counts: HealthArray

    @property
    def reset_method(self) -> ResetMethod:
        """See ``Pool.reset_method``."""
        return self._spec.reset_method

    def _count_steps(self) -> None:
        """Let the counts have all steps until now."""

    def _memory_growth(self) -> Any:
        """In bytes, for each instance or for all."""
        return 0

    def health(self) -> dict[str, HealthArray]:
        """See ``Pool.health``."""
        self._count_steps()
        columns = {name: self._counts[:, index].copy() for index, name in enumerate(HEALTH)}
        growth = np.full(len(self._counts), self._memory_growth(), np.int64)
        return columns | {"memory_growth": growth}

    def forget_health(self) -> None:
        """See ``Pool.forget_health``."""
        self._count_steps()
        self._counts[:] = 0

    def note_fault(self, index: int) -> None:
        """See ``Pool.note_fault``."""
        self._counts[index, Column.NOT_FINITE] += 1

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """What is told of each step, of shape (N,): how often it was repeated, if it may be."""
        if not self._spec.fault_retries:
            return {}
        return {"retries": self._counts[:, Column.RETRIED].copy()}


def fault_rates(health: dict[str, HealthArray]) -> npt.NDArray[np.float64]:
    """The part of the episodes that ended by a fault, of each instance, shape (N,)."""
    kinds: Iterable[str] = ("discards", "errors", "fatals", "not_finite", "deaths")
    faults = sum((health[kind] for kind in kinds), np.zeros_like(health["resets"]))
    rates: npt.NDArray[np.float64] = np.minimum(1.0, faults / np.maximum(1, health["resets"]))
    return rates
