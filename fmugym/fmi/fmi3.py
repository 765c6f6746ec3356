"""Co-simulation instances of FMI 3.0."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from fmpy.fmi3 import FMU3Slave, fmi3IntermediateUpdateCallback

from fmugym.fmi.instance import Instance
from fmugym.fmi.log import MessageLog, catching, fmi3_log_message
from fmugym.fmi.span import Initialize, Span
from fmugym.fmi.status import Status

__all__ = ["FMI3Instance"]


@fmi3IntermediateUpdateCallback  # type: ignore[untyped-decorator]  # ctypes has no types for this
@catching
def _ignore_intermediate_update(*arguments: Any) -> None:
    """Want no early return. FMUs may call this without asking whether it is there."""
    requested, time = arguments[6:8]
    if requested:
        requested[0] = False
    if time:
        time[0] = arguments[1]


class FMI3Instance(Instance):
    """FMI 3.0 co-simulation: the FMU handles its events within its steps."""

    slave_class = FMU3Slave
    dtypes: ClassVar[dict[str, Any]] = {
        "Float64": np.float64,
        "Float32": np.float32,
        "Int8": np.int8,
        "Int16": np.int16,
        "Int32": np.int32,
        "Int64": np.int64,
        "UInt8": np.uint8,
        "UInt16": np.uint16,
        "UInt32": np.uint32,
        "UInt64": np.uint64,
        "Boolean": np.uint8,
        "Clock": np.uint8,
    }
    enumeration_type = "Int64"
    _event_mode: ClassVar = False

    def _instantiate(self, log: MessageLog, logging: bool) -> None:
        resources = os.path.join(self._slave.unzipDirectory, "resources", "")
        self._slave.component = self._slave.fmi3InstantiateCoSimulation(
            self._slave.instanceName.encode(),
            self._slave.guid.encode(),
            resources.encode(),
            False,  # visible
            logging,
            self._event_mode,
            self._event_mode,  # early return allowed
            None,
            0,
            log.environment,
            fmi3_log_message,
            _ignore_intermediate_update,
        )

    def _function_name(self, name: str) -> str:
        return f"fmi3{name}"

    def _trailing_arguments(self, count: int) -> tuple[Any, ...]:
        return (ctypes.c_size_t(count),)

    def _prepare_step(self) -> Callable[[float, float], int]:
        double, pointer = ctypes.c_double, ctypes.c_void_p
        do_step = self._function(
            "DoStep", pointer, double, double, ctypes.c_bool, pointer, pointer, pointer, pointer
        )
        flags = (ctypes.c_bool * 3)()  # event handling needed, terminate, early return
        last_successful_time = double()
        results = [ctypes.addressof(flags) + i for i in range(3)]
        results.append(ctypes.addressof(last_successful_time))
        component, self._step_results = self._component, (flags, last_successful_time)
        no_return = not self._may_return

        def step_once(time: float, step_size: float) -> int:
            flags[1] = flags[2] = False  # an FMU may leave them unwritten
            last_successful_time.value = time
            return int(do_step(component, time, step_size, no_return, *results))

        def step(time: float, step_size: float) -> int:
            status, end = step_once(time, step_size), time + step_size
            while status <= Status.WARNING and flags[2] and not flags[1]:
                reached = last_successful_time.value  # early, although that was not allowed
                if reached >= end:
                    break
                if not reached > time:
                    status = Status.DISCARD
                    break
                time = reached
                status = step_once(time, end - time)
            if status <= Status.WARNING and flags[1]:
                status = Status.TERMINATED
            return status if status == 0 else self.judge_step(status)

        return step

    def _in_initialization(self, span: Span) -> None:
        """Do what is due in initialization mode: nothing."""

    def _prepare_initialization(self) -> Initialize:
        boolean, double = ctypes.c_bool, ctypes.c_double
        enter = self._function(
            "EnterInitializationMode", ctypes.c_void_p, boolean, double, double, boolean, double
        )
        leave = self._function("ExitInitializationMode")
        component, check = self._component, self.check

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            set_start_values()
            check("entering initialization", enter(component, *span.tolerances, *span.times))
            self._in_initialization(span)
            self.exchange_values()
            check("initialization", leave(component))

        return run
