"""Instances of co-simulation with event mode: the pool handles the events between their steps."""

from __future__ import annotations

import ctypes
from typing import ClassVar

from fmpy.fmi3 import FMU3Slave

from fmugym.fmi.exchange import ExchangeInstance
from fmugym.fmi.exchange_calls import FMI3Events, SetClocked
from fmugym.fmi.fmi3 import FMI3Instance
from fmugym.fmi.instance import Instance

__all__ = ["FMI3EventsInstance"]


class _Steps(FMI3Events):
    """The functions of co-simulation with event mode, in the form of those of model exchange."""

    steps_by_itself = True

    def __init__(self, instance: Instance, set_clocked: SetClocked) -> None:
        self._begin(instance, set_clocked)
        self.number_of_states = self.number_of_indicators = 0
        self.completes = False

    def enter_continuous(self) -> None:
        """See ``Equations.enter_continuous``: enter step mode."""
        self._call("EnterStepMode")

    def complete(self) -> tuple[bool, bool]:
        """See ``Equations.complete``: there is nothing to tell."""
        return False, False

    def step(self, time: float, size: float) -> tuple[float, bool, bool]:
        """See ``Equations.step``."""
        flags, reached = (ctypes.c_bool * 3)(), ctypes.c_double(time + size)
        first = ctypes.addressof(flags)  # event handling needed, terminate, early return
        self._call(
            "DoStep",
            ctypes.c_double(time),
            ctypes.c_double(size),
            ctypes.c_bool(False),
            *(ctypes.c_void_p(first + i) for i in range(3)),
            ctypes.byref(reached),
        )
        return reached.value if flags[2] else time + size, flags[0], flags[1]


class FMI3EventsInstance(ExchangeInstance, FMI3Instance):
    """FMI 3.0 co-simulation with event mode."""

    slave_class = FMU3Slave
    equations_class = _Steps
    _event_mode: ClassVar = True
