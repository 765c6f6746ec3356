"""One instance of a pool, as a pool of one."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool import Pool
from fmugym.pool.base import FloatArray, MaskArray, StatusArray
from fmugym.pool.bundle import Bundle, IndexArray, SaveMethod
from fmugym.pool.spec import ResetMethod

__all__ = ["PoolColumn"]


class PoolColumn(Pool):
    """One instance as a ``Pool``. Steps and resets do not touch the other instances.

    Args:
        pool: The pool of N instances.
        index: The index of the instance.
    """

    num_instances = 1

    def __init__(self, pool: Pool, index: int) -> None:
        self._pool, self._index = pool, index
        self._part = part = slice(index, index + 1)
        self.inputs: FloatArray = pool.inputs[:, part]
        self.outputs: FloatArray = pool.outputs[:, part]
        self.statuses: StatusArray = pool.statuses[part]
        self.observations = pool.observations[part]

    def _others(self) -> MaskArray:
        mask = np.ones(self._pool.num_instances, np.bool_)
        mask[self._index] = False
        return mask

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        all_values = np.repeat(values, self._pool.num_instances, axis=1)
        self._pool.reset(variables, all_values, ~self._others())
        return self.outputs, self.statuses

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        if inputs is not None:
            self.inputs[:] = inputs
        self._pool.step(None, self._others())
        return self.outputs, self.statuses

    def step_own(self) -> int:
        """See ``Pool.step_own``."""
        self.step()
        self.observations[0] = self.outputs[: self.observations.shape[1], 0]
        return int(self.statuses[0] > WARNING_CODE)

    @property
    def save_method(self) -> SaveMethod | None:
        """See ``Pool.save_method``."""
        return self._pool.save_method

    def save_instances(self, indices: IndexArray) -> Bundle:
        """See ``Pool.save_instances``."""
        return self._pool.save_instances(indices + self._index)

    def restore_instances(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> StatusArray:
        """See ``Pool.restore_instances``."""
        self._pool.restore_instances(bundle, sources, indices + self._index)
        return self.statuses

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        return self._pool.failure(self._index)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        return self._pool.read(variables)[:, self._part]

    def health(self) -> dict[str, npt.NDArray[np.int64]]:
        """See ``Pool.health``."""
        return {name: counts[self._part] for name, counts in self._pool.health().items()}

    def forget_health(self) -> None:
        """See ``Pool.forget_health``; this affects the counts of all instances."""
        self._pool.forget_health()

    @property
    def is_real(self) -> bool:
        """See ``Pool.is_real``."""
        return self._pool.is_real

    @property
    def reset_method(self) -> ResetMethod:
        """See ``Pool.reset_method``."""
        return self._pool.reset_method

    def halt(self) -> None:
        """See ``Pool.halt``; the other instances stop too."""
        self._pool.halt()

    def note_fault(self, index: int) -> None:
        """See ``Pool.note_fault``."""
        self._pool.note_fault(self._index)

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """See ``Pool.info``."""
        return {name: row[self._part] for name, row in self._pool.info().items()}

    def close(self) -> None:
        """Do nothing: the vector environment closes the pool."""
