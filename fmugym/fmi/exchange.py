"""Instances of model exchange: to their users they do steps, as those of co-simulation do."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from fmpy.fmi2 import FMU2Model, fmi2EventInfo

from fmugym.fmi.fmi2 import FMI2Instance
from fmugym.fmi.instance import Initialize, Instance, SavedState, Span
from fmugym.fmi.methods import State
from fmugym.fmi.solver import CallError, Equations, Events, Memory, Mode, Solver, Solving
from fmugym.fmi.status import Status, sane

__all__ = ["ExchangeInstance", "FMI2ExchangeInstance"]


class ExchangeInstance(Instance):
    """One instance of model exchange and the solver of its equations."""

    equations_class: ClassVar[type[FMUEquations]]

    _solver: Solver | None = None

    def _prepare_step(self) -> Callable[[float, float], int]:
        solver = self._own_solver()

        def step(time: float, step_size: float) -> int:
            status = solver.advance(time + step_size)
            return status if status == 0 else self.judge_step(status)

        return step

    def _own_solver(self) -> Solver:
        if self._solver is None:
            equations = self.equations_class(self)
            self._solver = Solver(equations, self._solving or Solving(), self._complain)
            self._last: dict[str, tuple[object, bytes]] = {}
        return self._solver

    def _complain(self, text: str) -> None:
        """Log what the solver says like a message of the FMU."""
        self._log.receive(Status.ERROR, "solver", text)

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
            try:
                solver.settle()
            except CallError as failure:
                self.check("the initial event", failure.status)

        return run

    def prepare_access(
        self, c_type: str, references: npt.NDArray[np.uint32], buffer: npt.NDArray[Any]
    ) -> tuple[Any, Any, tuple[Any, ...]]:
        """See ``Instance.prepare_access``. New values are an event, for they may jump."""
        get, set_, arguments = super().prepare_access(c_type, references, buffer)
        solver, access = self._own_solver(), object()

        def set_with_event(*arguments: Any) -> int:
            mode = solver.memory.mode
            if mode is not Mode.BEFORE_EVENTS:
                given = access, buffer.tobytes()
                if self._last.get(c_type) == given:
                    return Status.OK
                self._last[c_type] = given
            try:
                if mode is Mode.IN_CONTINUOUS_TIME:
                    solver.enter_events()
            except CallError as failure:
                return failure.status
            return int(set_(*arguments))

        return get, set_with_event, arguments

    def reset(self) -> None:
        """See ``Instance.reset``."""
        self._forget(Memory())
        super().reset()

    def save_state(self) -> SavedState:
        """See ``Instance.save_state``; the state has the solver's memory, too."""
        saved = super().save_state()
        saved.memory = self._own_solver().memory
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
        if len(data) < Memory.SIZE:
            self.check("deserializing a state", Status.ERROR)
        memory, rest = Memory.split(data)
        saved = super().deserialize(rest)
        saved.memory = memory
        return saved


class FMUEquations(Equations):
    """The functions that FMI 2.0 and 3.0 have in common, with arguments prepared once.

    Args:
        instance: The instance.
    """

    def __init__(self, instance: ExchangeInstance) -> None:
        description = instance._description
        model = description.model_exchange
        assert model is not None
        self._instance = instance
        self.number_of_states = model.number_of_states
        self.number_of_indicators = model.number_of_event_indicators
        self.completes = model.needs_completed_integrator_step
        derivatives = description.capabilities.provides_directional_derivatives
        self._state_references = model.state_references if derivatives else ()
        self._rate_references = model.derivative_references
        self._numbers = (ctypes.c_double * max(1, self.number_of_states))()
        self._indicators = (ctypes.c_double * max(1, self.number_of_indicators))()
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


def events(again: int, terminate: int, has_next: int, next_event: float) -> Events:
    """Make ``Events``; a time that is not a number is none."""
    known = has_next and next_event == next_event
    return Events(bool(again), bool(terminate), next_event if known else float("inf"))


class FMI2ExchangeInstance(ExchangeInstance, FMI2Instance):
    """FMI 2.0 model exchange."""

    slave_class = FMU2Model
    equations_class = _FMI2Equations
