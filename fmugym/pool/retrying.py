"""Resets of demanding FMUs: repeated while licences are refused, and told of if they are slow."""

from __future__ import annotations

import contextlib
import logging
from abc import abstractmethod
from collections.abc import Callable

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.errors import LicenceError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import FloatArray, MaskArray, StatusArray
from fmugym.pool.health import CountedPool
from fmugym.pool.licences import refusals, wait_for_licence
from fmugym.pool.progress import progress

__all__ = ["RetryingPool"]


class RetryingPool(CountedPool):
    """A pool whose resets may be tried again while licences are refused."""

    _patience: tuple[str, logging.Logger] | None = None
    """The FMU's name, and a logger that is told what takes long; None if resets are done once."""

    _release: Callable[[], None] | None = None

    @property
    def retries_resets(self) -> bool:
        """See ``Pool.retries_resets``."""
        return self._patience is not None

    def hold(self, release: Callable[[], None]) -> None:
        """Keep the claim of the instances until ``close``, which releases it."""
        self._release = release

    def _release_claim(self) -> None:
        if self._release is not None:
            self._release()

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        if self._patience is None:
            self._reset_some(variables, values, mask)
        else:
            self._reset_patiently(*self._patience, variables, values, mask)
        return self.outputs, self.statuses

    def _reset_some(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> None:
        """Reset instances; those that have failed without files of the FMU are reset with them."""
        if self._spec.makes_anew:
            self.extract()
        if self._reset_once(variables, values, mask) and self.extract():
            failed = self._as_mask(mask) & (self.statuses > WARNING_CODE)
            self._reset_once(variables, values, failed)

    @abstractmethod
    def _reset_once(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> int:
        """Reset once; return the number of troubled instances."""

    def _reset_patiently(
        self,
        name: str,
        log: logging.Logger,
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray | None,
    ) -> None:
        """Reset instances; those that get no licence are reset again."""
        chosen = self._as_mask(mask)
        what = f"{name}: the initialization of {np.count_nonzero(chosen)} instance(s)"

        def attempt() -> None:
            nonlocal chosen
            with progress(log, what):
                self._reset_some(variables, values, chosen)
            refused = refusals(self, chosen)
            if refused:
                chosen = np.isin(np.arange(self.num_instances), list(refused))
                raise LicenceError(next(iter(refused.values())))

        with contextlib.suppress(LicenceError):  # the statuses tell, as for every failure
            wait_for_licence(self._spec.licence_wait, log, attempt)
