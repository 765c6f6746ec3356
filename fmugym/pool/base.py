"""The contract that every pool fulfils, whatever steps its instances."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fmugym.model_description import Variable
from fmugym.pool.processors import available_processors
from fmugym.pool_spec import DEFAULT_CALL_TIMEOUT, ISOLATIONS, PoolSpec

__all__ = [
    "DEFAULT_CALL_TIMEOUT",
    "ISOLATIONS",
    "FloatArray",
    "MaskArray",
    "Pool",
    "PoolSpec",
    "StatusArray",
    "available_processors",
]

FloatArray = npt.NDArray[np.float64]
StatusArray = npt.NDArray[np.int8]
MaskArray = npt.NDArray[np.bool_]


class Pool(Protocol):
    """N instances of one FMU.

    Arrays have variables first, ``(k, N)``, so that a hook's ``x, v = state`` gives one row each.
    Outputs and statuses that come out are the pool's own arrays, always the same two, which the
    next call writes again.

    A status is a ``fmugym.adapters.Status``. What an FMU does wrong is never raised, since it
    concerns one instance only: its status tells, ``failure`` gives the reason, its outputs stay
    those before the call, and the next reset mends or replaces it. The same goes for an instance
    whose inputs are not finite, which is not stepped.
    """

    num_instances: int
    inputs: FloatArray
    """Shape (k_in, N), for the caller to write to before a step."""
    outputs: FloatArray
    """Shape (k, N)."""
    statuses: StatusArray
    """Shape (N,)."""
    observations: npt.NDArray[np.float32]
    """What ``step_own`` fills as ``step`` fills its argument, shape (N, num_observed)."""

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """Start instances anew, at the first communication point, warm-up included.

        Args:
            variables: The variables to be set before initialization, P of them; all numeric.
            values: Their values, shape (P, N); only the columns in the mask are used.
            mask: Which instances to start anew, shape (N,); None for all.

        Returns:
            The outputs, shape (k, N), and the statuses, shape (N,); of instances outside of the
            mask both are as before.
        """
        ...

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """Do one step with the instances.

        Args:
            inputs: Shape (k_in, N), finite, copied to ``self.inputs``; None for what is there.
            skip: Which instances not to step, shape (N,); their outputs and statuses stay.
            observations: Filled with the first ``num_observed`` outputs of all instances, shape
                (N, num_observed), C-contiguous.

        Returns:
            The outputs, shape (k, N), and the statuses, shape (N,).
        """
        ...

    def step_own(self) -> int:
        """Do one step with what was written to ``inputs``, and fill ``observations``.

        Returns:
            How many of the instances have a status worse than a warning.
        """
        ...

    def save(self) -> Any:
        """Copy the FMU states and times of all instances.

        Returns:
            A snapshot for ``restore`` of this very pool, freed when it is no longer referred to.

        Raises:
            SimulationError: If the FMU offers no state, or an instance cannot save it now.
        """
        ...

    def restore(
        self, snapshot: Any, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """Return instances to a snapshot.

        Args:
            snapshot: From ``save``.
            mask: Which instances, shape (N,); None for all.

        Returns:
            As ``reset``.

        Raises:
            SimulationError: If the snapshot is another pool's, or an instance was replaced since.
        """
        ...

    def failure(self, index: int) -> str:
        """Say why an instance's last status was worse than a warning."""
        ...

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """Read any numeric variables now, shape (len(variables), N).

        Raises:
            SimulationError: If an instance refuses.
        """
        ...

    def health(self) -> dict[str, npt.NDArray[np.int64]]:
        """What was counted of each instance, by name, each of shape (N,); see ``HEALTH``."""
        ...

    def forget_health(self) -> None:
        """Begin to count anew."""
        ...

    def close(self) -> None:
        """Free all instances; more than one call is fine."""
        ...
