"""What goes with resets of demanding FMUs: waiting for licences."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from fmugym.archive.description import Variable
from fmugym.errors import LicenceError
from fmugym.fmi.status import Status
from fmugym.pool.base import FloatArray, MaskArray, Pool
from fmugym.pool.patience import Patience, speaks_of_licence
from fmugym.pool.spec import PoolSpec

__all__ = ["Attendant", "Reset"]

Reset = Callable[[tuple[Variable, ...], FloatArray, MaskArray | None], Any]
"""A pool's own function for resets, without an attendant."""


class Attendant:
    """Goes with the resets of a pool.

    Args:
        spec: Says how long to wait for a licence.
        log: Is told what this waits for.
    """

    def __init__(self, spec: PoolSpec, log: logging.Logger) -> None:
        self._patience = Patience(spec.licence_wait, log)

    @classmethod
    def of(cls, spec: PoolSpec, log: logging.Logger) -> Attendant | None:
        """Make the attendant that a spec needs; None if it needs none."""
        return cls(spec, log) if spec.licence_wait else None

    def reset(
        self,
        pool: Pool,
        reset: Reset,
        variables: tuple[Variable, ...],
        values: FloatArray,
        mask: MaskArray | None,
    ) -> None:
        """Reset instances, and reset those again that get no licence.

        Args:
            pool: The pool.
            reset: Its function for resets.
            variables: As for ``Pool.reset``.
            values: As for ``Pool.reset``.
            mask: As for ``Pool.reset``.
        """
        chosen = np.ones(pool.num_instances, np.bool_) if mask is None else np.asarray(mask)

        def attempt() -> None:
            nonlocal chosen
            reset(variables, values, chosen)
            refused = _refusals(pool, chosen)
            if refused:
                chosen = np.isin(np.arange(pool.num_instances), list(refused))
                raise LicenceError(next(iter(refused.values())))

        try:
            self._patience.call(attempt)
        except LicenceError:  # the statuses tell, as for every failure
            return


def _refusals(pool: Pool, chosen: MaskArray) -> dict[int, str]:
    """The texts of the instances among the chosen ones that got no licence."""
    failed = np.flatnonzero(chosen & (pool.statuses > Status.WARNING)).tolist()
    texts = {index: pool.failure(index) for index in failed}
    return {index: text for index, text in texts.items() if speaks_of_licence(text)}
