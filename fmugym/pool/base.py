"""The contract that every pool fulfils, whatever steps its instances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from fmugym.model_description import Variable

__all__ = ["Pool", "PoolSpec"]


@dataclass(frozen=True)
class PoolSpec:
    """What a pool does at each reset and step.

    Attributes:
        inputs: The variables set before each step, in the order of the rows of ``step``'s argument.
        outputs: The variables read after each step, in the order of the rows of its result.
        time_step: Simulated time of one step, in seconds.
        substeps: Number of communication steps in one step.
        start_time: First communication point, in seconds.
        stop_time: Passed to the FMU where it is not None, in seconds.
        tolerance: Passed to the FMU where it is not None.
        warm_up_steps: Steps simulated at each reset, inputs at their start values, before the
            first output is read.
        strings: String parameters and their values.
    """

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    time_step: float
    substeps: int = 1
    start_time: float = 0.0
    stop_time: float | None = None
    tolerance: float | None = None
    warm_up_steps: int = 0
    strings: tuple[tuple[Variable, str], ...] = ()

    def communication_point(self, count: int) -> float:
        """The time after ``count`` communication steps; never a sum, which would drift."""
        return self.start_time + count * self.time_step / self.substeps

    @property
    def communication_step_size(self) -> float:
        """The step size that the FMU sees, in seconds."""
        return self.time_step / self.substeps


class Pool(Protocol):
    """N instances of one FMU.

    Arrays have variables first, ``(k, N)``, so that a hook's ``x, v = state`` gives one row each.
    Arrays that come out are the pool's own, valid until the next call.
    """

    num_instances: int

    def reset(
        self,
        variables: tuple[Variable, ...],
        values: npt.NDArray[np.float64],
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> npt.NDArray[np.float64]:
        """Start the instances anew.

        Args:
            variables: The variables to be set before initialization, P of them.
            values: Their values, shape (P, N).
            mask: Which instances to start anew, shape (N,); None for all.

        Returns:
            The outputs, shape (k, N); those of instances not in the mask are unchanged.

        Raises:
            SimulationError: If an instance cannot be initialized.
        """
        ...

    def step(
        self, inputs: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int8]]:
        """Do one step with all instances.

        Args:
            inputs: Shape (k_in, N), finite.

        Returns:
            The outputs, shape (k, N), and a ``Status`` per instance, shape (N,). After Error and
            Fatal the outputs are those before the step.
        """
        ...

    def failure(self, index: int) -> str:
        """Say why an instance's last status was worse than a warning."""
        ...

    def read(self, variables: tuple[Variable, ...]) -> npt.NDArray[np.float64]:
        """Read any variables now, shape (len(variables), N)."""
        ...

    def close(self) -> None:
        """Free all instances; more than one call is fine."""
        ...


def whole_number_of_steps(duration: float, time_step: float) -> int | None:
    """The number of steps in a duration, or None if it is not a whole one."""
    count = round(duration / time_step)
    return count if math.isclose(count * time_step, duration, abs_tol=1e-9) else None
