"""The functions of model exchange as each FMI version has them, with arguments prepared once."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any

from fmpy.fmi1 import fmi1EventInfo
from fmpy.fmi2 import fmi2EventInfo

from fmugym.archive.variable import Interval, Variable
from fmugym.fmi.clocks import CallError, Qualifier
from fmugym.fmi.equations import Equations, Events
from fmugym.fmi.instance import Instance
from fmugym.fmi.methods import State
from fmugym.fmi.status import Status, sane

__all__ = [
    "FMI1Equations",
    "FMI2Equations",
    "FMI3Equations",
    "FMI3Events",
    "FMUEquations",
    "SetClocked",
]

SetClocked = Callable[[Variable], None]


class FMUEquations(Equations):
    """The functions that FMI versions have in common.

    Args:
        instance: The instance.
        set_clocked: Sets the inputs that may be set while a clock ticks.
    """

    def __init__(self, instance: Instance, set_clocked: SetClocked) -> None:
        description = instance._description
        model = description.model_exchange
        assert model is not None
        self._begin(instance, set_clocked)
        self.number_of_states = model.number_of_states
        self.number_of_indicators = model.number_of_event_indicators
        self.completes = model.needs_completed_integrator_step
        derivatives = description.capabilities.provides_directional_derivatives
        self._state_references = model.state_references if derivatives else ()
        self._rate_references = model.derivative_references
        self._numbers = (ctypes.c_double * max(1, self.number_of_states))()
        self._indicators = (ctypes.c_double * max(1, self.number_of_indicators))()

    def _begin(self, instance: Instance, set_clocked: SetClocked) -> None:
        self._instance, self._set_clocked = instance, set_clocked
        self.clocks = instance._description.clocks
        self._functions: dict[str, Any] = {}

    def _call(self, name: str, *arguments: Any) -> None:
        function = self._functions.get(name)
        if function is None:
            function = self._functions[name] = self._instance._function(name)
        status = sane(function(self._instance._component, *arguments))
        if status > Status.WARNING:
            raise CallError(status)

    def _get(self, name: str, buffer: Any, count: int) -> State:
        self._call(name, buffer, ctypes.c_size_t(count))
        return list(buffer[:count])

    def set_time(self, time: float) -> None:
        """See ``Equations.set_time``."""
        self._call("SetTime", ctypes.c_double(time))

    def set_states(self, x: State) -> None:
        """See ``Equations.set_states``."""
        self._numbers[: len(x)] = x  # type: ignore[assignment]  # ctypes converts floats
        self._call("SetContinuousStates", self._numbers, ctypes.c_size_t(len(x)))

    def get_states(self) -> State:
        """See ``Equations.get_states``."""
        return self._get("GetContinuousStates", self._numbers, self.number_of_states)

    def get_rates(self) -> State:
        """See ``Equations.get_rates``."""
        return self._get("GetDerivatives", self._numbers, self.number_of_states)

    def get_indicators(self) -> State:
        """See ``Equations.get_indicators``."""
        return self._get("GetEventIndicators", self._indicators, self.number_of_indicators)

    def get_nominals(self) -> State:
        """See ``Equations.get_nominals``."""
        return self._get("GetNominalsOfContinuousStates", self._numbers, self.number_of_states)

    def enter_events(self) -> None:
        """See ``Equations.enter_events``."""
        self._call("EnterEventMode")

    def enter_continuous(self) -> None:
        """See ``Equations.enter_continuous``."""
        self._call("EnterContinuousTimeMode")

    def differentiate_by(self, state: int) -> State | None:
        """See ``Equations.differentiate_by``."""
        if not self._state_references:
            return None
        count = self.number_of_states
        trailing = self._instance._trailing_arguments
        self._call(
            "GetDirectionalDerivative",
            (ctypes.c_uint32 * count)(*self._rate_references),
            ctypes.c_size_t(count),
            ctypes.byref(ctypes.c_uint32(self._state_references[state])),
            ctypes.c_size_t(1),
            ctypes.byref(ctypes.c_double(1.0)),
            *trailing(1),
            self._numbers,
            *trailing(count),
        )
        return list(self._numbers[:count])

    # Clocks, which only FMI 3.0 has.

    def is_active(self, clock: Variable) -> bool:
        """See ``ClockCalls.is_active``."""
        active = ctypes.c_bool(False)
        self._call_for("GetClock", clock, active)
        return active.value

    def activate(self, clock: Variable) -> None:
        """See ``ClockCalls.activate``."""
        self._call_for("SetClock", clock, ctypes.c_bool(True))

    def interval(self, clock: Variable) -> tuple[Interval, Qualifier]:
        """See ``ClockCalls.interval``."""
        qualifier = ctypes.c_int(Qualifier.NOT_YET_KNOWN)
        if clock.by_fractions:
            interval = self._ask_for_fraction("GetIntervalFraction", clock, qualifier)
        else:
            interval = self._ask_for_decimal("GetIntervalDecimal", clock, qualifier)
        return interval, Qualifier(qualifier.value)

    def shift(self, clock: Variable) -> Interval:
        """See ``ClockCalls.shift``."""
        if clock.by_fractions:
            return self._ask_for_fraction("GetShiftFraction", clock)
        return self._ask_for_decimal("GetShiftDecimal", clock)

    def set_interval(self, clock: Variable) -> None:
        """See ``ClockCalls.set_interval``."""
        seconds, counter, resolution = clock.interval
        if clock.by_fractions and resolution:
            parts = ctypes.c_uint64(counter), ctypes.c_uint64(resolution)
            self._call_for("SetIntervalFraction", clock, *parts)
        else:
            self._call_for("SetIntervalDecimal", clock, ctypes.c_double(seconds))

    def _ask_for_decimal(self, name: str, clock: Variable, *qualifier: ctypes.c_int) -> Interval:
        seconds = ctypes.c_double()
        self._call_for(name, clock, seconds, *qualifier)
        return Interval(seconds.value)

    def _ask_for_fraction(self, name: str, clock: Variable, *qualifier: ctypes.c_int) -> Interval:
        counter, resolution = ctypes.c_uint64(), ctypes.c_uint64()
        self._call_for(name, clock, counter, resolution, *qualifier)
        return Interval(math.nan, counter.value, resolution.value)

    def set_inputs(self, clock: Variable) -> None:
        """See ``ClockCalls.set_inputs``."""
        self._set_clocked(clock)

    def _call_for(self, name: str, clock: Variable, *values: Any) -> None:
        reference = ctypes.c_uint32(clock.value_reference)
        places = [ctypes.byref(value) for value in values]
        self._call(name, ctypes.byref(reference), ctypes.c_size_t(1), *places)


class FMI1Equations(FMUEquations):
    """FMI 1.0 has no modes and no directional derivatives."""

    def enter_events(self) -> None:
        """Do nothing."""

    def enter_continuous(self) -> None:
        """Do nothing."""

    def get_nominals(self) -> State:
        """See ``Equations.get_nominals``."""
        return self._get("GetNominalContinuousStates", self._numbers, self.number_of_states)

    def update(self) -> Events:
        """See ``Equations.update``."""
        info = fmi1EventInfo()
        self._call("EventUpdate", ctypes.c_char(0), ctypes.byref(info))
        return _events(
            not _truth(info.iterationConverged),
            _truth(info.terminateSimulation),
            _truth(info.upcomingTimeEvent),
            info.nextEventTime,
        )

    def complete(self) -> tuple[bool, bool]:
        """See ``Equations.complete``."""
        event = ctypes.c_char(0)
        self._call("CompletedIntegratorStep", ctypes.byref(event))
        return _truth(event.value), False


class FMI2Equations(FMUEquations):
    """What FMI 2.0 has of its own: the update of discrete states, and complete steps."""

    def update(self) -> Events:
        """See ``Equations.update``."""
        info = fmi2EventInfo()
        self._call("NewDiscreteStates", ctypes.byref(info))
        return _events(
            info.newDiscreteStatesNeeded,
            info.terminateSimulation,
            info.nextEventTimeDefined,
            info.nextEventTime,
        )

    def complete(self) -> tuple[bool, bool]:
        """See ``Equations.complete``."""
        event, terminate = ctypes.c_int(0), ctypes.c_int(0)
        self._call("CompletedIntegratorStep", 0, ctypes.byref(event), ctypes.byref(terminate))
        return bool(event.value), bool(terminate.value)


class FMI3Events(FMUEquations):
    """The functions for events that both interfaces of FMI 3.0 have."""

    def update(self) -> Events:
        """See ``Equations.update``."""
        flags, next_event = (ctypes.c_bool * 5)(), ctypes.c_double()
        first = ctypes.addressof(flags)
        places = [ctypes.c_void_p(first + i) for i in range(5)]
        self._call("UpdateDiscreteStates", *places, ctypes.byref(next_event))
        return _events(flags[0], flags[1], flags[4], next_event.value)


class FMI3Equations(FMI3Events):
    """What model exchange of FMI 3.0 has of its own: another name, and its Booleans."""

    def get_rates(self) -> State:
        """See ``Equations.get_rates``."""
        return self._get("GetContinuousStateDerivatives", self._numbers, self.number_of_states)

    def complete(self) -> tuple[bool, bool]:
        """See ``Equations.complete``."""
        event, terminate = ctypes.c_bool(False), ctypes.c_bool(False)
        self._call(
            "CompletedIntegratorStep",
            ctypes.c_bool(False),
            ctypes.byref(event),
            ctypes.byref(terminate),
        )
        return event.value, terminate.value


def _events(again: bool, terminate: bool, has_next: bool, next_event: float) -> Events:
    """Make ``Events``; a time that is not a number is none."""
    known = has_next and next_event == next_event
    return Events(bool(again), bool(terminate), next_event if known else float("inf"))


def _truth(value: bytes) -> bool:
    """FMI 1.0 has characters as Booleans."""
    return value != b"\0"
