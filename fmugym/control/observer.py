"""Observer of a plant: it finds the copy of an FMU that is nearest to the measurements."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.environment.distributions import DrawnColumn, is_distribution
from fmugym.environment.env import FMUEnv
from fmugym.pool.pool import FloatArray

__all__ = ["COPIES", "CORRECTION", "Observer", "parameters_of_copies"]

COPIES: Final = 9
"""So many different copies run beside each environment."""

CORRECTION: Final = 0.3
"""By which part offsets follow the differences in a step, if nobody says another."""

_LASTING: Final = 0.98
"""The part of the past errors of a copy that counts after a step."""

_SAMPLES: Final = 1001
"""Number of samples of which the copies take quantiles."""


class Observer:
    """Estimates of copies that run beside a plant.

    Args:
        count: The number n of copies.
        measured: The number k of measured values.
        outputs: The number o of outputs of the FMU.
        correction: By which part the offsets follow the differences in a step, from 0 to 1.

    Attributes:
        errors: The sums of squared differences from what was measured, shape (n, k).
        offsets: Corrections of the outputs of each copy, shape (n, o).
    """

    def __init__(
        self, count: int, measured: int, outputs: int, correction: float = CORRECTION
    ) -> None:
        self.errors, self.offsets = np.zeros((count, measured)), np.zeros((count, outputs))
        self._correction = correction

    def follow(self, off: FloatArray, sources: Any = slice(None)) -> None:
        """Add measured values to the estimates of the copies.

        Args:
            off: The differences, 0 where nothing was measured, shape (n, k).
            sources: The copy in whose place each one is now.
        """
        self.errors = _LASTING * self.errors[sources] + off**2
        self.offsets = self.offsets[sources]

    def correct(self, wanted: FloatArray, which: Any = True) -> None:
        """Let the offsets follow.

        Args:
            wanted: Present errors of the outputs of each copy, shape (n, o).
            which: The outputs that are known.
        """
        self.offsets = self.offsets + which * self._correction * (wanted - self.offsets)

    @property
    def best(self) -> int:
        """Copy that fits best; measured values are weighted by the spread of the copies."""
        totals = self.errors.sum(axis=0)
        parts = self.errors / np.where(totals > 0.0, totals, 1.0)
        return int(parts.sum(axis=1).argmin())


def parameters_of_copies(env: FMUEnv, seed: int) -> dict[str, FloatArray]:
    """Values of the parameters that are drawn, by name, one for each copy; medians come first.

    Columns of a table have whole rows, from the nearest to the medians to one far away.
    """
    rng, found = np.random.default_rng(seed), {}
    others = np.delete(np.arange(COPIES), COPIES // 2)
    tables: dict[str, dict[str, FloatArray]] = {}
    for name, value in env.config.model_parameters.items():
        if type(value) is DrawnColumn:
            tables.setdefault(value.table, {})[name] = np.array(value.values, np.float64)
        elif is_distribution(value):
            drawn = [value.sample(rng) for _ in range(_SAMPLES)]
            each = np.quantile(drawn, (np.arange(COPIES) + 0.5) / COPIES)
            found[name] = each[[COPIES // 2, *rng.permutation(others)]]
    for columns in tables.values():
        rows = _some_rows(np.array([*columns.values()]))
        found |= {name: values[rows] for name, values in columns.items()}
    return found


def _some_rows(columns: FloatArray) -> npt.NDArray[np.intp]:
    """The numbers of rows, from the middle of a table outwards."""
    widths = columns.std(axis=1, keepdims=True)
    off = (columns - np.median(columns, axis=1, keepdims=True)) / np.where(widths > 0, widths, 1)
    outwards = np.argsort((off**2).sum(axis=0))
    return outwards[np.arange(COPIES) * len(outwards) // COPIES]
