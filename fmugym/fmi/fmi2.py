"""Co-simulation instances of FMI 2.0."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from fmpy.fmi2 import FMU2Slave

from fmugym.fmi.instance import Instance
from fmugym.fmi.log import MessageLog, fmi2_callbacks
from fmugym.fmi.span import Initialize, Span
from fmugym.fmi.status import Status, sane

__all__ = ["FMI2Instance"]


class FMI2Instance(Instance):
    """FMI 2.0 co-simulation."""

    slave_class = FMU2Slave
    dtypes: ClassVar[dict[str, Any]] = {
        "Real": np.float64,
        "Integer": np.int32,
        "Boolean": np.int32,
    }

    _LAST_SUCCESSFUL_TIME: ClassVar = 2
    _TERMINATED: ClassVar = 3
    """Of ``fmi2StatusKind``."""

    def _instantiate(self, log: MessageLog, logging: bool) -> None:
        self._slave.instantiate(callbacks=fmi2_callbacks, loggingOn=logging)

    def _function_name(self, name: str) -> str:
        return f"fmi2{name}"

    _deserialize: ClassVar = "DeSerialize"

    def _state_function(self, verb: str) -> str:
        return f"{verb}FMUstate"

    def _prepare_step(self) -> Callable[[float, float], int]:
        double = ctypes.c_double
        do_step = self._function("DoStep", ctypes.c_void_p, double, double, ctypes.c_int)
        component, no_return = self._component, not self._may_return

        def step(time: float, step_size: float) -> int:
            status: int = do_step(component, time, step_size, no_return)
            if status == Status.DISCARD:
                end = time + step_size
                status = self._go_on(
                    lambda now: do_step(component, now, end - now, no_return), time, end
                )
            return status if status == 0 else self.judge_step(status)

        return step

    def _go_on(self, step_from: Callable[[float], int], time: float, end: float) -> int:
        """Do the rest of a discarded step, from where the FMU returned.

        An FMU that has done nothing of it, or refuses to go on, has discarded it.
        """
        status = self._judge_discard()
        while status == Status.DISCARD:
            reached = self._last_successful_time(time)
            if not time < reached < end:
                return Status.DISCARD
            time = reached
            status = sane(step_from(time))
            if status == Status.ERROR:
                return Status.DISCARD
            if status == Status.DISCARD:
                status = self._judge_discard()
        return status

    def _last_successful_time(self, time: float) -> float:
        """The time at which a discarded step ended; the FMU need not tell it."""
        last = ctypes.c_double(time)
        get_status = self._function("GetRealStatus")
        status = get_status(self._component, self._LAST_SUCCESSFUL_TIME, ctypes.byref(last))
        return last.value if sane(status) <= Status.WARNING else time

    def _judge_discard(self) -> int:
        """Find out why a step was discarded. If the FMU cannot tell, it counts as Discard."""
        terminated = ctypes.c_int(0)
        get_status = self._function("GetBooleanStatus")
        status = get_status(self._component, self._TERMINATED, ctypes.byref(terminated))
        if status == Status.FATAL:
            return Status.FATAL
        asked_to_stop = status <= Status.WARNING and terminated.value != 0
        return Status.TERMINATED if asked_to_stop else Status.DISCARD

    def _prepare_initialization(self) -> Initialize:
        double, integer = ctypes.c_double, ctypes.c_int
        setup = self._function(
            "SetupExperiment", ctypes.c_void_p, integer, double, double, integer, double
        )
        enter = self._function("EnterInitializationMode")
        leave = self._function("ExitInitializationMode")
        component, check = self._component, self.check

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            check("setting up the experiment", setup(component, *span.tolerances, *span.times))
            set_start_values()
            check("entering initialization", enter(component))
            self.exchange_values()
            check("initialization", leave(component))

        return run
