"""Instances of model exchange: to their users they do steps, as those of co-simulation do."""

from __future__ import annotations

import ctypes
import math
import os
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
from fmpy.fmi1 import FMU1Model, fmi1EventInfo
from fmpy.fmi2 import FMU2Model, fmi2EventInfo
from fmpy.fmi3 import FMU3Model

from fmugym.archive.variable import Interval, Variable
from fmugym.fmi.clocks import CallError, Qualifier
from fmugym.fmi.fmi1 import FMI1Instance
from fmugym.fmi.fmi2 import FMI2Instance
from fmugym.fmi.fmi3 import FMI3Instance
from fmugym.fmi.instance import Initialize, Instance, SavedState, Span
from fmugym.fmi.log import MessageLog, fmi1_callbacks, fmi3_log_message
from fmugym.fmi.methods import State
from fmugym.fmi.solver import Equations, Events, Memory, Mode, Solver, Solving
from fmugym.fmi.status import Status, sane

__all__ = [
    "ExchangeInstance",
    "FMI1ExchangeInstance",
    "FMI2ExchangeInstance",
    "FMI3Events",
    "FMI3ExchangeInstance",
]


class _LastSet(NamedTuple):
    """The values that were last set of one C type: inputs that stay the same need no event."""

    access: object
    references: npt.NDArray[np.uint32]
    values: npt.NDArray[Any]

    def is_that(self, other: _LastSet | None) -> bool:
        """Whether the same access set the same values, to the last bit."""
        if other is None or other.access is not self.access:
            return False
        return other.values.tobytes() == self.values.tobytes()


class ExchangeInstance(Instance):
    """One instance of model exchange and the solver of its equations."""

    equations_class: ClassVar[type[FMUEquations]]

    _solver: Solver | None = None

    def _prepare_step(self) -> Callable[[float, float], int]:
        solver = self._own_solver()

        def step(time: float, step_size: float) -> int:
            solver.begin_step(time)
            status = solver.advance(time + step_size)
            return status if status == 0 else self.judge_step(status)

        return step

    def _own_solver(self) -> Solver:
        if self._solver is None:
            equations = self.equations_class(self)
            self._solver = Solver(equations, self._solving or Solving(), self._complain)
            inputs = self._description.clocked_inputs
            self._clocked = {v.value_reference: v.clocks for v in inputs}
            arrays = (*inputs, *self._description.arrays_beside_clocked)
            self._widths = {v.value_reference: v.size for v in arrays}
            self._last: dict[str, _LastSet] = {}
        return self._solver

    def _forget(self, memory: Memory) -> None:
        self._own_solver().forget(memory)
        self._last.clear()

    def _prepare_initialization(self) -> Initialize:
        solver = self._own_solver()
        # the class of the FMI version, which stands between this one and Instance
        initialize = super()._prepare_initialization()  # type: ignore[safe-super]

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            self._forget(Memory(time=span.start_time))
            initialize(span, set_start_values)
            solver.forget(Memory(time=span.start_time, mode=Mode.IN_EVENTS))
            self._check_call("the initial event", solver.settle)

        return run

    def _in_initialization(self, span: Span) -> None:
        timetable = self._own_solver().timetable
        self._check_call("preparing the clocks", lambda: timetable.prepare(span.start_time))

    def _check_call(self, doing: str, call: Callable[[], None]) -> None:
        try:
            call()
        except CallError as failure:
            if failure.reason:
                self._complain(failure.reason)
            self.check(doing, failure.status)

    def prepare_access(
        self, c_type: str, references: npt.NDArray[np.uint32], buffer: npt.NDArray[Any]
    ) -> tuple[Any, Any, tuple[Any, ...]]:
        """See ``Instance.prepare_access``. New values are an event, for they may jump."""
        solver, access = self._own_solver(), object()
        if c_type == "Clock":
            return self._prepare_clocks(references.tolist(), buffer)
        get, set_, arguments = super().prepare_access(c_type, references, buffer)

        def set_with_event(*arguments: Any) -> int:
            mode = solver.memory.mode
            if mode is not Mode.BEFORE_EVENTS:
                given = _LastSet(access, references, buffer.copy())
                if given.is_that(self._last.get(c_type)):
                    return Status.OK
                self._last[c_type] = given
            try:
                if mode is Mode.IN_CONTINUOUS_TIME:
                    solver.enter_events()
                if mode is not Mode.BEFORE_EVENTS and self._clocked:
                    self._set_some(c_type, lambda r: r not in self._clocked)
                    return Status.OK
            except CallError as failure:
                self._last.pop(c_type, None)
                return failure.status
            return int(set_(*arguments))

        return get, set_with_event, arguments

    def _prepare_clocks(
        self, references: list[int], buffer: npt.NDArray[Any]
    ) -> tuple[Any, Any, tuple[Any, ...]]:
        solver = self._own_solver()

        def get() -> int:
            buffer[:] = solver.timetable.tell(references)
            return Status.OK

        def set_() -> int:
            solver.timetable.ask(references, buffer.tolist())
            try:
                if buffer.any() and solver.memory.mode is Mode.IN_CONTINUOUS_TIME:
                    solver.enter_events()
            except CallError as failure:
                return failure.status
            return Status.OK

        return get, set_, ()

    def set_clocked(self, clock: Variable) -> None:
        """Set the inputs that may be set while this clock ticks to the values given last."""
        due = {r for r, clocks in self._clocked.items() if clock.value_reference in clocks}
        for c_type in self._last if due else ():
            self._set_some(c_type, due.__contains__)

    def _set_some(self, c_type: str, wanted: Callable[[int], bool]) -> None:
        """Set those of the values that were last set whose references are wanted."""
        _, references, values = self._last[c_type]
        place = 0
        for i, reference in enumerate(references.tolist()):
            begin, place = place, place + self._widths.get(reference, 1)
            if wanted(reference):
                own = references[i : i + 1], values[begin:place]
                _, set_, arguments = super().prepare_access(c_type, *own)
                status = sane(set_(*arguments))
                if status > Status.WARNING:
                    raise CallError(status)

    def reset(self) -> None:
        """See ``Instance.reset``."""
        self._forget(Memory())
        super().reset()

    def save_state(self) -> SavedState:
        """See ``Instance.save_state``; the state has the solver's memory, too."""
        saved = super().save_state()
        saved.memory = self._own_solver().saved_memory
        return saved

    def restore_state(self, state: SavedState) -> None:
        """See ``Instance.restore_state``."""
        self._forget(state.memory)
        super().restore_state(state)

    def serialize(self, state: SavedState) -> bytes:
        """See ``Instance.serialize``."""
        memory: Memory = state.memory
        return memory.to_bytes() + super().serialize(state)

    def deserialize(self, data: bytes) -> SavedState:
        """See ``Instance.deserialize``."""
        size = Memory.size(len(self._description.clocks))
        if len(data) < size:
            self.check("deserializing a state", Status.ERROR)
        saved = super().deserialize(data[size:])
        saved.memory = Memory.from_bytes(data[:size])
        return saved


class FMUEquations(Equations):
    """The functions that FMI versions have in common, with arguments prepared once.

    Args:
        instance: The instance.
    """

    def __init__(self, instance: ExchangeInstance) -> None:
        description = instance._description
        model = description.model_exchange
        assert model is not None
        self._begin(instance)
        self.number_of_states = model.number_of_states
        self.number_of_indicators = model.number_of_event_indicators
        self.completes = model.needs_completed_integrator_step
        derivatives = description.capabilities.provides_directional_derivatives
        self._state_references = model.state_references if derivatives else ()
        self._rate_references = model.derivative_references
        self._numbers = (ctypes.c_double * max(1, self.number_of_states))()
        self._indicators = (ctypes.c_double * max(1, self.number_of_indicators))()

    def _begin(self, instance: ExchangeInstance) -> None:
        self._instance = instance
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
        self._instance.set_clocked(clock)

    def _call_for(self, name: str, clock: Variable, *values: Any) -> None:
        reference = ctypes.c_uint32(clock.value_reference)
        places = [ctypes.byref(value) for value in values]
        self._call(name, ctypes.byref(reference), ctypes.c_size_t(1), *places)


class _FMI1Equations(FMUEquations):
    """FMI 1.0 has no modes and no directional derivatives."""

    def enter_events(self) -> None:
        """Do nothing."""

    def enter_continuous(self) -> None:
        """Do nothing."""

    def get_nominals(self) -> State:
        return self._get("GetNominalContinuousStates", self._numbers, self.number_of_states)

    def update(self) -> Events:
        info = fmi1EventInfo()
        self._call("EventUpdate", ctypes.c_char(0), ctypes.byref(info))
        return events(
            not _truth(info.iterationConverged),
            _truth(info.terminateSimulation),
            _truth(info.upcomingTimeEvent),
            info.nextEventTime,
        )

    def complete(self) -> tuple[bool, bool]:
        event = ctypes.c_char(0)
        self._call("CompletedIntegratorStep", ctypes.byref(event))
        return _truth(event.value), False


class _FMI2Equations(FMUEquations):
    def update(self) -> Events:
        info = fmi2EventInfo()
        self._call("NewDiscreteStates", ctypes.byref(info))
        return events(
            info.newDiscreteStatesNeeded,
            info.terminateSimulation,
            info.nextEventTimeDefined,
            info.nextEventTime,
        )

    def complete(self) -> tuple[bool, bool]:
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
        return events(flags[0], flags[1], flags[4], next_event.value)


class _FMI3Equations(FMI3Events):
    def get_rates(self) -> State:
        return self._get("GetContinuousStateDerivatives", self._numbers, self.number_of_states)

    def complete(self) -> tuple[bool, bool]:
        event, terminate = ctypes.c_bool(False), ctypes.c_bool(False)
        self._call(
            "CompletedIntegratorStep",
            ctypes.c_bool(False),
            ctypes.byref(event),
            ctypes.byref(terminate),
        )
        return event.value, terminate.value


def events(again: bool, terminate: bool, has_next: bool, next_event: float) -> Events:
    """Make ``Events``; a time that is not a number is none."""
    known = has_next and next_event == next_event
    return Events(bool(again), bool(terminate), next_event if known else float("inf"))


def _truth(value: bytes) -> bool:
    """FMI 1.0 has characters as Booleans."""
    return value != b"\0"


class _FMI1Model(FMI1Instance):
    """The calls of FMI 1.0 model exchange that are not those of co-simulation."""

    _SLAVE_FUNCTIONS: ClassVar = {"FreeInstance": "FreeModelInstance"}

    @classmethod
    def mend(cls, slave: Any) -> None:
        """Do nothing: FMPy declares the results of these functions as it should."""

    def _instantiate(self, log: MessageLog, logging: bool) -> None:
        self._slave.component = self._slave.fmi1InstantiateModel(
            self._slave.instanceName.encode(), self._slave.guid.encode(), fmi1_callbacks, logging
        )

    def _find_reset(self) -> Callable[[Any], int]:
        return lambda _: Status.ERROR  # FMI 1.0 has no such function

    def _prepare_initialization(self) -> Initialize:
        set_time = self._function("SetTime", ctypes.c_void_p, ctypes.c_double)
        initialize = self._function(
            "Initialize", ctypes.c_void_p, ctypes.c_char, ctypes.c_double, ctypes.c_void_p
        )

        def run(span: Span, set_start_values: Callable[[], None]) -> None:
            set_start_values()
            has_tolerance, tolerance = span.tolerances
            info = fmi1EventInfo()
            status = set_time(self._component, span.start_time)
            if sane(status) <= Status.WARNING:
                flag, place = bytes([has_tolerance]), ctypes.byref(info)
                status = initialize(self._component, flag, tolerance, place)
            self.check("initialization", status)

        return run


class FMI1ExchangeInstance(ExchangeInstance, _FMI1Model):
    """FMI 1.0 model exchange."""

    slave_class = FMU1Model
    equations_class = _FMI1Equations


class FMI2ExchangeInstance(ExchangeInstance, FMI2Instance):
    """FMI 2.0 model exchange."""

    slave_class = FMU2Model
    equations_class = _FMI2Equations


class _FMI3Model(FMI3Instance):
    """The call of FMI 3.0 model exchange that is not that of co-simulation."""

    def _instantiate(self, log: MessageLog, logging: bool) -> None:
        resources = os.path.join(self._slave.unzipDirectory, "resources", "")
        self._slave.component = self._slave.fmi3InstantiateModelExchange(
            self._slave.instanceName.encode(),
            self._slave.guid.encode(),
            resources.encode(),
            False,  # visible
            logging,
            log.environment,
            fmi3_log_message,
        )


class FMI3ExchangeInstance(ExchangeInstance, _FMI3Model):
    """FMI 3.0 model exchange."""

    slave_class = FMU3Model
    equations_class = _FMI3Equations
