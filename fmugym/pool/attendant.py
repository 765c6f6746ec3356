"""What goes with resets of demanding FMUs: waiting for licences, and telling what takes long."""

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
from fmugym.pool.patience import Patience, speaks_of_licence
from fmugym.pool.progress import progress
from fmugym.pool.spec import PoolSpec

__all__ = ["Attendant", "AttendedPool"]

Reset = Callable[[tuple[Variable, ...], FloatArray, MaskArray | None], Any]
"""A pool's own function for resets, without an attendant."""


class Attendant:
    """Waits for licences, and tells what takes long.

    Args:
        name: The FMU, for messages.
        spec: Says how long to wait for a licence.
        log: Is told what this waits for.
    """

    def __init__(self, name: str, spec: PoolSpec, log: logging.Logger) -> None:
        self._name, self._log = name, log
        self._patience = Patience(spec.licence_wait, log)

    @classmethod
    def of(cls, name: str, spec: PoolSpec, log: logging.Logger) -> Attendant | None:
        """Make the attendant that a pool needs; None if it needs none."""
        needed = spec.licence_wait or log.isEnabledFor(logging.INFO)
        return cls(name, spec, log) if needed else None

    def reset(
        self,
        pool: AttendedPool,
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
            self._patience.call(attempt)


def _refusals(pool: Pool, chosen: MaskArray) -> dict[int, str]:
    """The texts of the instances among the chosen ones that got no licence."""
    failed = np.flatnonzero(chosen & (pool.statuses > WARNING_CODE)).tolist()
    texts = {index: pool.failure(index) for index in failed}
    return {index: text for index, text in texts.items() if speaks_of_licence(text)}


class AttendedPool(CountedPool):
    """A pool whose resets may have an attendant."""

    _attendant: Attendant | None = None

    @property
    def is_attended(self) -> bool:
        """See ``Pool.is_attended``."""
        return self._attendant is not None

    _release: Callable[[], None] | None = None

    def hold(self, release: Callable[[], None]) -> None:
        """Keep the seats of the instances until ``close``, which releases them."""
        self._release = release

    def _return_seats(self) -> None:
        if self._release is not None:
            self._release()

    def attend(self, attendant: Attendant | None) -> None:
        """Give all calls of ``reset`` an attendant from now on."""
        self._attendant = attendant

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        if self._attendant is None:
            self._reset_some(variables, values, mask)
        else:
            self._attendant.reset(self, self._reset_some, variables, values, mask)
        return self.outputs, self.statuses

    @abstractmethod
    def _reset_some(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> Any:
        """Do what ``reset`` does, without an attendant."""
