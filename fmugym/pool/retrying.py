"""Resets of demanding FMUs: repeated while licences are refused, and told of if they are slow."""

from __future__ import annotations

import contextlib
import logging
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.errors import LicenceError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import FloatArray, MaskArray, Pool, StatusArray
from fmugym.pool.health import CountedPool
from fmugym.pool.licences import LicenceWait, speaks_of_licence
from fmugym.pool.progress import progress
from fmugym.pool.spec import PoolSpec

__all__ = ["ResetRetry", "RetryingPool"]

Reset = Callable[[tuple[Variable, ...], FloatArray, MaskArray | None], Any]
"""A pool's own function for resets, which tries once."""


class ResetRetry:
    """Tries resets again while licences are refused, and tells what takes long.

    Args:
        name: The FMU, for messages.
        spec: Says how long to wait for a licence.
        log: Is told what this waits for.
    """

    def __init__(self, name: str, spec: PoolSpec, log: logging.Logger) -> None:
        self._name, self._log = name, log
        self._wait = LicenceWait(spec.licence_wait, log)

    @classmethod
    def of(cls, name: str, spec: PoolSpec, log: logging.Logger) -> ResetRetry | None:
        """Make one; None if a pool neither waits for licences nor tells of slow resets."""
        needed = spec.licence_wait or log.isEnabledFor(logging.INFO)
        return cls(name, spec, log) if needed else None

    def reset(
        self,
        pool: RetryingPool,
        reset: Reset,
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray | None,
    ) -> None:
        """Reset instances; those that get no licence are reset again.

        Args:
            pool: The pool.
            reset: Its function for resets.
            variables: As for ``Pool.reset``.
            values: As for ``Pool.reset``.
            mask: As for ``Pool.reset``.
        """
        chosen = np.ones(pool.num_instances, np.bool_) if mask is None else np.asarray(mask)
        what = f"{self._name}: the initialization of {np.count_nonzero(chosen)} instance(s)"

        def attempt() -> None:
            nonlocal chosen
            with progress(self._log, what):
                reset(variables, values, chosen)
            refused = _refusals(pool, chosen)
            if refused:
                chosen = np.isin(np.arange(pool.num_instances), list(refused))
                raise LicenceError(next(iter(refused.values())))

        with contextlib.suppress(LicenceError):  # the statuses tell, as for every failure
            self._wait.call(attempt)


def _refusals(pool: Pool, chosen: MaskArray) -> dict[int, str]:
    """The texts of the instances among the chosen ones that got no licence."""
    failed = np.flatnonzero(chosen & (pool.statuses > WARNING_CODE)).tolist()
    texts = {index: pool.failure(index) for index in failed}
    return {index: text for index, text in texts.items() if speaks_of_licence(text)}


class RetryingPool(CountedPool):
    """A pool whose resets may be tried again."""

    _retry: ResetRetry | None = None

    @property
    def retries_resets(self) -> bool:
        """See ``Pool.retries_resets``."""
        return self._retry is not None

    _release: Callable[[], None] | None = None

    def hold(self, release: Callable[[], None]) -> None:
        """Keep the claim of the instances until ``close``, which releases it."""
        self._release = release

    def _release_claim(self) -> None:
        if self._release is not None:
            self._release()

    def retry_by(self, retry: ResetRetry | None) -> None:
        """Let all calls of ``reset`` be tried again from now on; None for one try."""
        self._retry = retry

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        if self._retry is None:
            self._reset_some(variables, values, mask)
        else:
            self._retry.reset(self, self._reset_some, variables, values, mask)
        return self.outputs, self.statuses

    @abstractmethod
    def _reset_some(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> Any:
        """Do what ``reset`` does, once."""
