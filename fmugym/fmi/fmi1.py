"""Co-simulation instances of FMI 1.0."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Final

import numpy as np
from fmpy.fmi1 import FMU1Slave

from fmugym.fmi.instance import Instance
from fmugym.fmi.log import MessageLog, fmi1_callbacks
from fmugym.fmi.span import Initialize, Span
from fmugym.fmi.status import Status

_TRUE: Final = b"\x01"
_FALSE: Final = b"\x00"

__all__ = ["FMI1Instance"]


class FMI1Instance(Instance):
    """FMI 1.0 stand-alone co-simulation, without FMU state and without a status for Terminated."""

    slave_class = FMU1Slave
    dtypes: ClassVar[dict[str, Any]] = {
        "Real": np.float64,
        "Integer": np.int32,
        "Boolean": np.uint8,
    }

    _SLAVE_FUNCTIONS: ClassVar = {
        "Reset": "ResetSlave",
        "Terminate": "TerminateSlave",
        "FreeInstance": "FreeSlaveInstance",
    }
    _STATUS_FUNCTIONS: ClassVar = (
        "fmi1InitializeSlave",
        "fmi1DoStep",
        "fmi1CancelStep",
        "fmi1GetStatus",
        "fmi1GetRealStatus",
        "fmi1GetIntegerStatus",
        "fmi1GetBooleanStatus",
        "fmi1GetStringStatus",
        "fmi1GetRealOutputDerivatives",
        "fmi1SetRealInputDerivatives",
    )

    @classmethod
    def mend(cls, slave: Any) -> None:
        """Declare int results. FMPy declares strings, and dereferences every status except OK."""
        for name in cls._STATUS_FUNCTIONS:
            slave._functions[name].restype = ctypes.c_int

    def _instantiate(self, log: MessageLog, logging: bool) -> None:
        self._slave.instantiate(functions=fmi1_callbacks, loggingOn=logging)

    def _choose_messages(self, _: Sequence[str]) -> int:
        """Do nothing: FMI 1.0 has no log categories."""
        return Status.OK

    def _function_name(self, name: str) -> str:
        name = self._SLAVE_FUNCTIONS.get(name, name)
        return f"{self._description.model_identifier}_fmi{name}"

    def _prepare_step(self) -> Callable[[float, float], int]:
        double = ctypes.c_double
        do_step = self._function("DoStep", ctypes.c_void_p, double, double, ctypes.c_char)
        component = self._component

        def step(time: float, step_size: float) -> int:
            status: int = do_step(component, time, step_size, _TRUE)
            return status if status == 0 else self.judge_step(status)

        return step

    def _prepare_initialization(self) -> Initialize:
        double = ctypes.c_double
        initialize = self._function(
            "InitializeSlave", ctypes.c_void_p, double, ctypes.c_char, double
        )

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            set_start_values()
            start, has_stop, stop = span.times
            defined = _TRUE if has_stop else _FALSE
            status = initialize(self._component, start, defined, stop)
            self.check("initialization", status)

        return run
