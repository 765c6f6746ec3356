"""What goes with resets of demanding FMUs: waiting for licences, and telling what takes long."""

from __future__ import annotations

import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.errors import LicenceError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import FloatArray, MaskArray, Pool, StatusArray
from fmugym.pool.health import CountedPool
from fmugym.pool.patience import Patience, speaks_of_licence
from fmugym.pool.progress import INITIALIZATION, STEP, announce, hears_calls, progress
from fmugym.pool.spec import PoolSpec

__all__ = ["Attendant", "AttendedPool"]

Reset = Callable[[tuple[Variable, ...], FloatArray, MaskArray | None], Any]
"""A pool's own function for resets, without an attendant."""


@dataclass(frozen=True)
class InitialState:
    """A serialized FMU state just after initialization and warm-up.

    Attributes:
        outputs: The outputs then, float64, shape (k,), as bytes.
        data: The FMU's own bytes.
    """

    outputs: bytes
    data: bytes


class Attending(ABC):
    """Goes with the resets of a pool."""

    @abstractmethod
    def reset(
        self,
        pool: AttendedPool,
        reset: Reset,
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray | None,
    ) -> None:
        """Reset instances, and do whatever else belongs to it.

        Args:
            pool: The pool.
            reset: Its function for resets.
            variables: As for ``Pool.reset``.
            values: As for ``Pool.reset``.
            mask: As for ``Pool.reset``.
        """


class Attendant(Attending):
    """Waits for licences, and tells what takes long.

    Args:
        name: The FMU, for messages.
        spec: Says how long to wait for a licence.
        log: Is told what this waits for.
        inner: Goes with the resets, too.
    """

    def __init__(
        self, name: str, spec: PoolSpec, log: logging.Logger, inner: Attending | None = None
    ) -> None:
        self._name, self._log, self._inner = name, log, inner
        self._patience = Patience(spec.licence_wait, log)

    @classmethod
    def of(
        cls, name: str, spec: PoolSpec, log: logging.Logger, inner: Attending | None = None
    ) -> Attending | None:
        """Make the attendant that a pool needs besides another one; None if it needs none."""
        needed = spec.licence_wait or log.isEnabledFor(logging.INFO) or hears_calls()
        return cls(name, spec, log, inner) if needed else inner

    def reset(
        self,
        pool: AttendedPool,
        reset: Reset,
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray | None,
    ) -> None:
        """See ``Attending.reset``; instances that get no licence are reset again."""
        chosen = np.ones(pool.num_instances, np.bool_) if mask is None else np.asarray(mask)
        what = f"{self._name}: the initialization of {np.count_nonzero(chosen)} instance(s)"

        def attempt() -> None:
            nonlocal chosen
            with progress(self._log, what):
                if self._inner is None:
                    reset(variables, values, chosen)
                else:
                    self._inner.reset(pool, reset, variables, values, chosen)
            refused = _refusals(pool, chosen)
            if refused:
                chosen = np.isin(np.arange(pool.num_instances), list(refused))
                raise LicenceError(next(iter(refused.values())))

        announce(INITIALIZATION)
        with contextlib.suppress(LicenceError):  # the statuses tell, as for every failure
            self._patience.call(attempt)
        announce(STEP)


def _refusals(pool: Pool, chosen: MaskArray) -> dict[int, str]:
    """The texts of the instances among the chosen ones that got no licence."""
    failed = np.flatnonzero(chosen & (pool.statuses > WARNING_CODE)).tolist()
    texts = {index: pool.failure(index) for index in failed}
    return {index: text for index, text in texts.items() if speaks_of_licence(text)}


class AttendedPool(CountedPool):
    """A pool whose resets somebody may go with."""

    _attendant: Attending | None = None

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

    def attend(self, attendant: Attending | None) -> None:
        """Let somebody go with all calls of ``reset`` from now on."""
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

    # Initial states that instances share; the defaults are for pools that cannot share them.

    def knows_start(self, index: int, variables: tuple[Variable, ...], values: FloatArray) -> bool:
        """Whether a reset of an instance with these start values, shape (P,), restores a state."""
        return False

    def pack(self, index: int) -> InitialState | None:
        """Serialize the state of an instance that has just been reset; None if it refuses."""
        return None

    def adopt(
        self,
        index: int,
        variables: tuple[Variable, ...],
        values: FloatArray,
        state: InitialState,
    ) -> bool:
        """Let an instance restore a state at its next reset with these start values.

        If its outputs then differ from those of the state, it is initialized.

        Returns:
            Whether the FMU took the state.
        """
        return False
