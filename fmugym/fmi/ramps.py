"""Co-simulation of FMI 1.0 and 2.0 with inputs that change linearly within a step.

This does what ``native/ramps.c`` does, operation by operation.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.fmi.fmi1 import FMI1Instance
from fmugym.fmi.fmi2 import FMI2Instance
from fmugym.fmi.instance import Instance, SavedState
from fmugym.fmi.solver import Memory, Mode
from fmugym.fmi.span import Initialize, Span
from fmugym.fmi.status import Status, sane

__all__ = ["RAMPED_CLASSES"]

_RAMP: Final = struct.Struct("=ddd")


class _Ramp(NamedTuple):
    """One input.

    Attributes:
        start: When it leaves the first value; NaN before the next step.
    """

    first: float
    last: float
    start: float

    def at(self, time: float, duration: float) -> tuple[float, float]:
        """Value and derivative."""
        slope, passed = (self.last - self.first) / duration, time - self.start
        if passed > (1.0 - 1e-9) * duration:
            return self.last, 0.0
        return self.first + slope * passed, slope


class _Ramped(Instance):
    """An instance whose inputs aim at the values that are set."""

    _ramps: tuple[_Ramp, ...] = ()

    @property
    def _references(self) -> tuple[int, ...]:
        assert self._solving is not None
        return self._solving.ramps

    def _prepare_step(self) -> Callable[[float, float], int]:
        # the class of the FMI version, which stands between this one and Instance
        step = super()._prepare_step()  # type: ignore[safe-super]  # a mixin

        def ramped_step(time: float, step_size: float) -> int:
            status = self._set_ramps(time)
            if status > Status.WARNING:
                return self.judge_step(status)
            return step(time, step_size)

        return ramped_step

    def _set_ramps(self, time: float) -> int:
        assert self._solving is not None
        duration = self._solving.ramp_duration
        begun = (r._replace(start=time) if math.isnan(r.start) else r for r in self._ramps)
        self._ramps = tuple(begun)
        values, slopes = zip(*(ramp.at(time, duration) for ramp in self._ramps), strict=True)
        count = len(values)
        references = (ctypes.c_uint32 * count)(*self._references)
        size = ctypes.c_size_t(count)
        set_values = self._function("SetReal")
        numbers = (ctypes.c_double * count)(*values)
        status = sane(set_values(self._component, references, size, numbers))
        if status > Status.WARNING:
            return status
        orders = (ctypes.c_int * count)(*[1] * count)
        numbers = (ctypes.c_double * count)(*slopes)
        set_slopes = self._function("SetRealInputDerivatives")
        return sane(set_slopes(self._component, references, size, orders, numbers))

    def _prepare_initialization(self) -> Initialize:
        initialize = super()._prepare_initialization()  # type: ignore[safe-super]  # a mixin

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            self._ramps = ()
            initialize(span, set_start_values)
            self._ramps = tuple(_Ramp(x, x, span.start_time) for x in self._read_inputs())

        return run

    def _read_inputs(self) -> Sequence[float]:
        references = np.array(self._references, np.uint32)
        values = np.zeros(len(references))
        get, _, arguments = super().prepare_access("Real", references, values)
        self.check("reading the inputs", get(*arguments))
        return [float(value) for value in values]

    def prepare_access(
        self, c_type: str, references: npt.NDArray[np.uint32], buffer: npt.NDArray[Any]
    ) -> tuple[Any, Any, tuple[Any, ...]]:
        """See ``Instance.prepare_access``. Inputs with ramps are set with the next step."""
        get, set_, arguments = super().prepare_access(c_type, references, buffer)
        known = {reference: place for place, reference in enumerate(self._references)}
        aims = [(i, known[r]) for i, r in enumerate(references.tolist()) if r in known]
        if c_type != "Real" or not aims:
            return get, set_, arguments
        others = [i for i, r in enumerate(references.tolist()) if r not in known]
        rest = np.zeros(len(others))
        _, set_rest, rest_arguments = super().prepare_access(c_type, references[others], rest)

        def aim(*_: Any) -> int:
            if not self._ramps:  # before initialization
                return int(set_(*arguments))
            ramps = list(self._ramps)
            for i, place in aims:
                ramps[place] = _Ramp(ramps[place].last, float(buffer[i]), math.nan)
            self._ramps = tuple(ramps)
            rest[:] = buffer[others]
            return int(set_rest(*rest_arguments)) if others else Status.OK

        return get, aim, arguments

    def reset(self) -> None:
        """See ``Instance.reset``."""
        self._ramps = ()
        super().reset()

    def save_state(self) -> SavedState:
        """See ``Instance.save_state``; the state has the ramps, too."""
        saved = super().save_state()
        saved.memory = self._ramps
        return saved

    def restore_state(self, state: SavedState) -> None:
        """See ``Instance.restore_state``."""
        self._ramps = state.memory
        super().restore_state(state)

    def serialize(self, state: SavedState) -> bytes:
        """See ``Instance.serialize``; the native pool has a solver's memory before the ramps."""
        own = b"".join(_RAMP.pack(*ramp) for ramp in state.memory)
        return Memory(mode=Mode.IN_CONTINUOUS_TIME).to_bytes() + own + super().serialize(state)

    def deserialize(self, data: bytes) -> SavedState:
        """See ``Instance.deserialize``."""
        begin = Memory.size(0)
        end = begin + len(self._references) * _RAMP.size
        if len(data) < end:
            self.check("deserializing a state", Status.ERROR)
        saved = super().deserialize(data[end:])
        saved.memory = tuple(_Ramp(*values) for values in _RAMP.iter_unpack(data[begin:end]))
        return saved


class _RampedFMI1(_Ramped, FMI1Instance):
    """FMI 1.0."""


class _RampedFMI2(_Ramped, FMI2Instance):
    """FMI 2.0."""


RAMPED_CLASSES: Final[dict[int, type[Instance]]] = {1: _RampedFMI1, 2: _RampedFMI2}
