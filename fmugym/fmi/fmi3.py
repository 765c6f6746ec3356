"""Co-simulation instances of FMI 3.0."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from fmpy.fmi3 import FMU3Slave, fmi3IntermediateUpdateCallback

from fmugym.fmi.instance import Initialize, Instance, Span
from fmugym.fmi.log import MessageLog, fmi3_log_message
from fmugym.fmi.status import Status

__all__ = ["FMI3Instance"]


class FMI3Instance(Instance):
    """FMI 3.0 co-simulation without event mode, early return and intermediate update."""

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
    }
    enumeration_type = "Int64"

    def _instantiate(self, log: MessageLog, logging: bool) -> None:
        resources = os.path.join(self._slave.unzipDirectory, "resources", "")
        self._slave.component = self._slave.fmi3InstantiateCoSimulation(
            self._slave.instanceName.encode(),
            self._slave.guid.encode(),
            resources.encode(),
            False,  # visible
            logging,
            False,  # event mode used
            False,  # early return allowed
            None,
            0,
            log.environment,
            fmi3_log_message,
            fmi3IntermediateUpdateCallback(),
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

        def step(time: float, step_size: float) -> int:
            flags[1] = flags[2] = False  # an FMU may leave them unwritten
            status: int = do_step(component, time, step_size, no_return, *results)
            if status <= Status.WARNING and flags[1]:
                status = Status.TERMINATED
            elif status <= Status.WARNING and flags[2]:  # early return was not allowed
                status = Status.DISCARD
            return status if status == 0 else self.judge_step(status)

        return step

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
            self.exchange_values()
            check("initialization", leave(component))

        return run
