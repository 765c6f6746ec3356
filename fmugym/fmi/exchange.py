"""Instances of model exchange: to their users they do steps, as those of co-simulation do."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
from fmpy.fmi1 import FMU1Model, fmi1EventInfo
from fmpy.fmi2 import FMU2Model
from fmpy.fmi3 import FMU3Model

from fmugym.archive.variable import Variable
from fmugym.fmi.clocks import CallError
from fmugym.fmi.exchange_calls import (
    FMI1Equations,
    FMI2Equations,
    FMI3Equations,
    FMUEquations,
)
from fmugym.fmi.fmi1 import FMI1Instance
from fmugym.fmi.fmi2 import FMI2Instance
from fmugym.fmi.fmi3 import FMI3Instance
from fmugym.fmi.instance import Instance, SavedState
from fmugym.fmi.log import MessageLog, fmi1_callbacks, fmi3_log_message
from fmugym.fmi.solver import Memory, Mode, Solver, Solving
from fmugym.fmi.span import Initialize, Span
from fmugym.fmi.status import Status, sane

__all__ = [
    "ExchangeInstance",
    "FMI1ExchangeInstance",
    "FMI2ExchangeInstance",
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
            equations = self.equations_class(self, self._set_clocked)
            self._solver = Solver(equations, self._solving or Solving(), self._complain)
            inputs = self._description.clocked_inputs
            self._clocked = {v.value_reference: v.clocks for v in inputs}
            arrays = (*inputs, *self._description.arrays_beside_clocked)
            self._widths = {v.value_reference: v.size for v in arrays}
            self._last: dict[str, _LastSet] = {}
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

    def _set_clocked(self, clock: Variable) -> None:
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
    equations_class = FMI1Equations


class FMI2ExchangeInstance(ExchangeInstance, FMI2Instance):
    """FMI 2.0 model exchange."""

    slave_class = FMU2Model
    equations_class = FMI2Equations


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
    equations_class = FMI3Equations
