"""Steps of a system whose sizes follow from an estimate of the error.

This is the arithmetic of ``native/system_control.c``, operation by operation.
"""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.fmi.status import Status
from fmugym.systems.plan import Control

__all__ = ["Repeatable", "StepControl"]

_SAFETY: Final = 0.9
_SHRINK: Final = 0.2
_GROWTH: Final = 2.0
_ROUNDING: Final = 1e-9
_RESOLUTION: Final = 16.0 * sys.float_info.epsilon
_PARTS: Final = 1024.0
_STEPS, _REJECTED, _NEXT, _WORST, _FIRST = range(5)

Vector = npt.NDArray[np.float64]


class Repeatable(ABC):
    """What can save its state, step, and go back. The functions raise for what cannot be mended."""

    @abstractmethod
    def keep(self) -> Any:
        """Save the state."""

    @abstractmethod
    def go_back(self, state: Any) -> None:
        """Restore a state."""

    @abstractmethod
    def try_step(self, time: float, size: float) -> int:
        """Step once; returns OK, TERMINATED, or a status after which a smaller step may succeed."""

    @abstractmethod
    def sources(self) -> Vector:
        """A copy of the values that are compared."""


class StepControl:
    """Steps of a size that keeps the error within a tolerance.

    Args:
        control: The tolerance.
        nominals: The nominal values of what is compared.

    Attributes:
        statistics: What ``fmugym.systems.plan.STATISTICS`` names, then the errors.
    """

    def __init__(self, control: Control, nominals: Sequence[float]) -> None:
        self._control, self._nominals = control, nominals
        self.statistics: Vector = np.zeros(_FIRST + len(nominals))
        self._errors = [0.0] * len(nominals)

    def step(self, system: Repeatable, time: float, step: float) -> int:
        """Do one step as several; returns the status of the last.

        Args:
            system: Steps.
            time: The current communication point, in seconds.
            step: The step size, in seconds.
        """
        smallest = self._smallest_step(time, step)
        self._begin(step)
        done, status = 0.0, int(Status.OK)
        while status == Status.OK and done < step:
            rest = step - done
            status, size = self._advance(system, time + done, rest, smallest)
            done = done + size if size < rest else step
            self.statistics[_NEXT] = _clamped(float(self.statistics[_NEXT]), smallest, step)
        return status

    def _smallest_step(self, time: float, step: float) -> float:
        """A step that the time does not show would be repeated for ever."""
        told = self._control.min_step_size or 0.0
        smallest = told if 0.0 < told < step else step / _PARTS
        shown = _RESOLUTION * (abs(time) + step)
        return smallest if smallest > shown else shown

    def _begin(self, step: float) -> None:
        self.statistics[_WORST] = 0.0
        self.statistics[_FIRST:] = 0.0
        if not self.statistics[_NEXT] > 0.0:
            self.statistics[_NEXT] = step

    def _advance(
        self, system: Repeatable, time: float, rest: float, smallest: float
    ) -> tuple[int, float]:
        """Do one step of at most the next size, as often as it takes."""
        before = system.keep()
        size = _divided(rest, float(self.statistics[_NEXT]))
        while True:
            is_last = size <= smallest * (1.0 + _ROUNDING)
            status, ratio = self._attempt(system, before, time, size)
            good = status in (Status.OK, Status.TERMINATED)
            if good and (ratio <= 1.0 or is_last or status == Status.TERMINATED):
                self._count(ratio)
                self.statistics[_NEXT] = size * _factor_of(ratio)
                return status, size
            if not good and is_last:
                return status, size
            self.statistics[_REJECTED] += 1.0
            self._go_back(system, before)
            size = _divided(rest, _clamped(size * _factor_of(ratio), smallest, rest))

    def _attempt(
        self, system: Repeatable, before: Any, time: float, size: float
    ) -> tuple[int, float]:
        """Step at once, and again by halves; returns the status, and the error by the tolerance."""
        status = system.try_step(time, size)
        if status not in (Status.OK, Status.TERMINATED):
            return status, math.inf
        coarse = system.sources()
        self._go_back(system, before)
        half = 0.5 * size
        status = system.try_step(time, half)
        if status == Status.TERMINATED:
            self._errors = [0.0] * len(self._nominals)
            return status, 0.0
        if status == Status.OK:
            status = system.try_step(time + half, half)
        good = status in (Status.OK, Status.TERMINATED)
        return status, self._compare(coarse, system.sources()) if good else math.inf

    def _go_back(self, system: Repeatable, before: Any) -> None:
        """What the master tells goes on although the components go back."""
        kept = self.statistics.copy()
        system.go_back(before)
        self.statistics[:] = kept

    def _compare(self, coarse: Vector, fine: Vector) -> float:
        triples = zip(coarse.tolist(), fine.tolist(), self._nominals, strict=True)
        worst = 0.0
        for index, (one, other, nominal) in enumerate(triples):
            size = abs(other) if abs(other) > nominal else nominal
            error = abs(other - one)
            ratio = error / (self._control.tolerance * size)
            self._errors[index] = error
            worst = worst if ratio <= worst else ratio
            if not math.isfinite(ratio):
                return math.inf
        return worst

    def _count(self, ratio: float) -> None:
        values = self.statistics
        values[_STEPS] += 2.0
        values[_WORST] = values[_WORST] if values[_WORST] >= ratio else ratio
        for index, error in enumerate(self._errors, _FIRST):
            values[index] = values[index] if values[index] >= error else error


def _factor_of(ratio: float) -> float:
    factor = _SAFETY / math.sqrt(ratio) if ratio > 0.0 else _GROWTH
    return _GROWTH if factor > _GROWTH else max(factor, _SHRINK)


def _divided(rest: float, size: float) -> float:
    """The rest of a step in equal parts of at most this size."""
    parts = float(math.ceil(rest / size - _ROUNDING))
    return rest / parts if parts > 1.0 else rest


def _clamped(size: float, smallest: float, largest: float) -> float:
    least = size if size > smallest else smallest
    return least if least < largest else largest
