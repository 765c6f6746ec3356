"""What a step gives of the values that outputs have after each of its substeps."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["Samples"]


class Samples:
    """The values of one step. The order of operations is that of ``native/steps.c``.

    Args:
        samplings: One of ``fmugym.pool.spec.SAMPLINGS`` for each output.
        step_size: Length of a substep in seconds.
    """

    def __init__(self, samplings: Sequence[str], step_size: float) -> None:
        self._samplings, self._step_size = samplings, step_size
        self._collected: list[float] = []
        self._count = 0

    def add(self, values: list[float]) -> None:
        """Add the outputs after one more substep."""
        if self._count:
            pairs = zip(self._samplings, self._collected, values, strict=True)
            values = [_collect(sampling, before, value) for sampling, before, value in pairs]
        self._collected = values
        self._count += 1

    def conclude(self) -> list[float]:
        """Return the outputs of the step."""
        pairs = zip(self._samplings, self._collected, strict=True)
        return [self._result(sampling, value) for sampling, value in pairs]

    def _result(self, sampling: str, value: float) -> float:
        if sampling == "mean":
            return value / self._count
        return value * self._step_size if sampling == "integral" else value


def _collect(sampling: str, before: float, value: float) -> float:
    match sampling:
        case "mean" | "integral":
            return before + value
        case "min":
            return before if before <= value else value
        case "max":
            return before if before >= value else value
    return value
