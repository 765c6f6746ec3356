"""Episodes that instances on trial play."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.licences import require_licence

__all__ = ["Starts", "start", "steps"]

_NUDGE: Final = 0.01
"""How far equal start values of two episodes are moved apart, as a fraction."""


@dataclass(frozen=True)
class Starts:
    """Different start values of two episodes, or of two instances.

    Attributes:
        variables: The P variables that are set before initialization.
        values: Their values, shape (P, 2).
    """

    variables: tuple[Variable, ...] = ()
    values: tuple[tuple[float, float], ...] = ()

    def columns(self, *indices: int) -> FloatArray:
        """The values of some episodes or instances, shape (P, len(indices))."""
        return np.array(self.values, np.float64).reshape(-1, 2)[:, indices]

    def apart(self) -> Starts:
        """The same start values, but Reals that are equal in both episodes are one percent apart.

        An attribute that is set later may change them, although the config does not.
        """
        pairs = zip(self.variables, self.values, strict=True)
        return replace(self, values=tuple(_apart(variable, *pair) for variable, pair in pairs))


def _apart(variable: Variable, first: float, second: float) -> tuple[float, float]:
    if first != second or variable.kind != "real":
        return first, second
    distance = _NUDGE * (abs(first) or abs(variable.nominal or 1.0))
    above, below = first + distance, first - distance
    return first, above if above <= variable.maximum or below < variable.minimum else below


def start(pool: Pool, starts: Starts, *indices: int) -> FloatArray:
    """Start an episode.

    Args:
        pool: N instances.
        starts: The start values.
        indices: Which of them each instance gets.

    Returns:
        A copy of the outputs, shape (k, N).

    Raises:
        LicenceError: If the first instance gets no licence.
    """
    outputs, _ = pool.reset(starts.variables, starts.columns(*indices))
    require_licence(pool)
    return outputs.copy()


def steps(pool: Pool, inputs: FloatArray) -> Iterator[FloatArray]:
    """Do steps while the first instance is well.

    Args:
        pool: N instances.
        inputs: Shape (steps, k_in, N).

    Yields:
        A copy of the outputs after each step, shape (k, N).
    """
    for row in inputs:
        if pool.statuses[0] > WARNING_CODE:
            return
        outputs, _ = pool.step(row)
        yield outputs.copy()
