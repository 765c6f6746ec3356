"""Instances of systems: to their users they are instances of one FMU.

With ``parts``, ``initialization`` and ``master`` this does what ``native/system.c`` and its
siblings do, operation by operation.
"""

from __future__ import annotations

import logging
import struct
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from fmugym.archive.variable import Variable
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.chain import chained_jacobian
from fmugym.fmi.control import Repeatable, StepControl
from fmugym.fmi.initialization import Initialization
from fmugym.fmi.instance import Instance, SavedState
from fmugym.fmi.log import Hearing, MessageLog
from fmugym.fmi.master import Master
from fmugym.fmi.parts import FailedError, Memory, Part, Parts, scaled
from fmugym.fmi.span import Initialize, Span
from fmugym.fmi.status import Phase, Status, failed_call
from fmugym.systems.description import MASTER, PartVariable, SystemDescription
from fmugym.systems.layout import Layout

__all__ = ["SystemInstance"]


class SystemInstance(Instance, Repeatable):
    """One instance of a system; made by ``Library.instantiate``.

    Args:
        layout: The slots and routes.
        instances: Those of the components, in their order.
        target: The logger for the system's own messages.
        resets: How each component begins an episode: ``"restore"``, ``"reset"``, or anything else
            for a new instance.
        renew: Makes the instance of a component anew, given its number and the old one.
    """

    dtypes: ClassVar[dict[str, Any]] = {"Float64": np.float64}

    def __init__(
        self,
        layout: Layout,
        instances: Iterable[Instance],
        target: logging.Logger,
        resets: Sequence[str],
        renew: Callable[[int, Instance], Instance],
    ) -> None:
        self._resets = resets
        self._renew, self._life = renew, object()
        self._layout = layout
        self._description: SystemDescription = layout.description
        self._log = MessageLog(self._description.model_identifier, target)
        self._hearing, self.hears_all = Hearing(), True
        self.phase = Phase.INSTANTIATED
        self._saved_states: weakref.WeakSet[SavedState] = weakref.WeakSet()
        nominals = [nominal for _, nominal in layout.compared]
        control = layout.plan.control
        self._control = None if control is None else StepControl(control, nominals)
        statistics = None if self._control is None else self._control.statistics
        self._parts = Parts(layout, instances, statistics)
        self._master = Master(self._parts)
        self._initialization = Initialization(self._parts, resets, self._reset_part)
        self._who = ""
        self.step = self._step

    # What one instance of an FMU does otherwise.

    def _instantiate(self, log: MessageLog, logging: bool) -> None:
        raise NotImplementedError

    def _function_name(self, name: str) -> str:
        raise NotImplementedError

    def _prepare_step(self) -> Callable[[float, float], int]:
        return self._step

    def _prepare_initialization(self) -> Initialize:
        raise NotImplementedError

    @property
    def can_say_more(self) -> bool:
        """Whether a component may say more if it is made anew."""
        return any(part.instance.can_say_more for part in self._parts.all)

    @property
    def is_silent(self) -> bool:
        """Whether no component has logged anything in this episode."""
        return all(part.instance.is_silent for part in self._parts.all)

    @property
    def hears_more_than_wanted(self) -> bool:
        """Whether a component logs everything although the logger drops most of it."""
        return any(part.instance.hears_more_than_wanted for part in self._parts.all)

    def begin_episode(self) -> None:
        """Forget the messages of the episode before."""
        for part in self._parts.all:
            part.instance.begin_episode()

    @property
    def life(self) -> object:
        """See ``Instance.life``; it ends when a component is made anew."""
        return self._life

    def c_type(self, variable: Variable) -> str:
        """The values of a system are all of one type."""
        return "Float64"

    def describe_failure(self, doing: str, status: int) -> str:
        """Say which call failed and in which component, with its last messages."""
        said = "".join(part.instance._log.said() for part in self._parts.all)
        return f"{self._log.instance_name}: {failed_call(doing, status, self._who)}{said}"

    def _tell(self, failure: FailedError) -> int:
        self._who = failure.who
        return failure.status

    def free(self) -> None:
        """Terminate and free the instances of all components."""
        for part in self._parts.all:
            part.instance.free()
        self.phase = Phase.DEAD
        self._log.close()

    # Values

    def prepare_access(
        self, c_type: str, references: npt.NDArray[np.uint32], buffer: npt.NDArray[Any]
    ) -> tuple[Any, Any, tuple[Any, ...]]:
        """See ``Instance.prepare_access``."""
        ends = [self._description.ends[reference] for reference in references.tolist()]

        def get() -> int:
            return self._trying(lambda: self._get_all(ends, buffer))

        def set_() -> int:
            return self._trying(lambda: self._set_all(ends, buffer))

        return get, set_, ()

    def _trying(self, action: Callable[[], None]) -> int:
        self._who = ""
        try:
            action()
        except FailedError as failure:
            return self._tell(failure)
        return Status.OK

    def _get_all(self, ends: Sequence[tuple[PartVariable, ...]], buffer: npt.NDArray[Any]) -> None:
        for index, behind in enumerate(ends):
            end = behind[0]
            buffer[index] = scaled(*end.reading, self._get(end))

    def _get(self, end: PartVariable) -> float:
        if self._control is not None and end.part == MASTER:
            return float(self._control.statistics[end.variable.value_reference])
        part = self._parts.all[end.part]
        output, given = self._layout.output_slot(end), self._layout.input_slot(end)
        if output >= 0 and self._parts.fresh:
            return float(part.outputs.values[output - part.layout.first_output])
        if given >= 0:
            return float(part.inputs.values[given - part.layout.first_input])
        return part.get((end.variable,))[0]

    def _set_all(self, ends: Sequence[tuple[PartVariable, ...]], buffer: npt.NDArray[Any]) -> None:
        for behind, value in zip(ends, buffer.tolist(), strict=True):
            for end in behind:
                self._set(end, scaled(end.gain, end.offset, value))

    def _set(self, end: PartVariable, value: float) -> None:
        part = self._parts.all[end.part]
        given = self._layout.input_slot(end)
        if given >= 0:
            part.inputs.values[given - part.layout.first_input] = value
        if self._initialization.pending is not None:
            self._initialization.pending.append((end, value))
        elif given < 0:
            self._parts.fresh = False
            self._set_alone(part, end.variable, value)

    def _set_alone(self, part: Part, variable: Variable, value: float) -> None:
        """Set a scalar, or one element of an array, of which the others stay as they are."""
        whole = (variable if variable.array is None else variable.array).elements
        values = [value] if variable.array is None else part.get(whole)
        values[variable.place] = value
        part.set(whole, values)

    def set_string(self, variable: Variable, value: str) -> None:
        """See ``Instance.set_string``."""
        assert self._initialization.pending is not None
        ends = self._description.ends[variable.value_reference]
        self._initialization.pending += [(end, value) for end in ends]

    def get_string(self, variable: Variable) -> tuple[int, str]:
        """See ``Instance.get_string``."""
        end = self._description.ends[variable.value_reference][0]
        part = self._parts.all[end.part]
        status, text = part.instance.get_string(end.variable)
        return int(self._trying(lambda: part.judge(status))), text

    # Initialization: the components are initialized one inside of the other.

    def initialize(
        self,
        start_time: float,
        stop_time: float | None,
        tolerance: float | None,
        set_start_values: Callable[[], None],
    ) -> None:
        """See ``Instance.initialize``."""
        self._require(Phase.INSTANTIATED, "initialize")
        Instance.initializations += 1
        self._who = ""
        try:
            self._initialization.run(Span(start_time, stop_time, tolerance), set_start_values)
        except FailedError as failure:
            self._fail_initialization()
            if failure.status == Status.FATAL:
                self.phase = Phase.DEAD
            self._tell(failure)
            text = self.describe_failure("initialization", failure.status)
            raise SimulationError(text) from None
        except BaseException:
            self._fail_initialization()
            raise
        self.phase = Phase.STEPPING

    def _fail_initialization(self) -> None:
        if self.phase is Phase.INSTANTIATED:
            self.phase = Phase.FAILED

    # Steps

    def _step(self, time: float, step_size: float) -> int:
        self._who, self._master.terminated = "", False
        self._initialization.kept.stepped = True
        try:
            if self._control is not None:
                status = self._control.step(self, time, step_size)
                return self.judge_step(status) if status else status
            self._master.step(time, step_size)
        except FailedError as failure:
            return self.judge_step(self._tell(failure))
        return self.judge_step(Status.TERMINATED) if self._master.terminated else Status.OK

    # What the estimate of errors needs

    def keep(self) -> SavedState:
        """See ``Repeatable.keep``."""
        states = tuple(self._parts.save(index) for index in range(len(self._parts.all)))
        return self._own(Memory(*self._parts.slots(), self._parts.fresh, states))

    def go_back(self, state: Any) -> None:
        """See ``Repeatable.go_back``."""
        for index, own in enumerate(state.memory.states):
            self._parts.restore(index, own)
        self._parts.put_slots(state.memory)

    def try_step(self, time: float, size: float) -> int:
        """See ``Repeatable.try_step``."""
        self._master.terminated = False
        try:
            self._master.step(time, size)
        except FailedError as failure:
            if failure.status not in (Status.DISCARD, Status.NOT_FINITE):
                raise
            return self._tell(failure)
        return Status.TERMINATED if self._master.terminated else Status.OK

    def sources(self) -> npt.NDArray[np.float64]:
        """See ``Repeatable.sources``."""
        outputs = np.frombuffer(self._parts.slots()[1])
        return outputs[[place for place, _ in self._layout.compared]]

    def judge_step(self, status: int) -> int:
        """See ``Instance.judge_step``; values for other components may be no numbers."""
        if status != Status.NOT_FINITE:
            return super().judge_step(status)
        self.forbid_steps()
        return status

    def jacobian(
        self, unknowns: Sequence[Variable], knowns: Sequence[Variable]
    ) -> npt.NDArray[np.float64]:
        """See ``Instance.jacobian``; the derivatives of the components make those of the system."""
        self._require(Phase.STEPPING, "differentiate")
        behind = [
            [self._layout.ends_of(variable) for variable in some] for some in (unknowns, knowns)
        ]
        found: npt.NDArray[np.float64] = chained_jacobian(
            self._layout,
            lambda part, of, by: self._parts.all[part].instance.jacobian(of, by)[None],
            1,
            *behind,
        )[0]
        return found

    # States and resets

    def reset(self) -> None:
        """See ``Instance.reset``."""
        if self.phase is Phase.DEAD:
            raise SimulationError(
                f"{self._log.instance_name}: no reset is legal after a fatal error"
            )
        for index in self._initialization.others:
            self._reset_part(index)
        self.phase = Phase.INSTANTIATED

    def _reset_part(self, index: int) -> None:
        part = self._parts.all[index]
        if not part.started:
            return
        if self._resets[index] in ("restore", "reset"):
            part.instance.reset()
            part.started = False
            return
        self._life = object()
        try:
            part.renew(self._renew(index, part.instance))
        except FMULoadError as error:
            self.phase = Phase.DEAD
            raise SimulationError(f"{part.label}: {error}") from None

    def save_state(self) -> SavedState:
        """See ``Instance.save_state``."""
        if not self._description.capabilities.can_get_and_set_fmu_state:
            raise SimulationError(f"{self._description.model_name} cannot get and set its state")
        self._require(Phase.STEPPING, "save the FMU state")
        with self._failing("saving the FMU state"):
            return self.keep()

    @contextmanager
    def _failing(self, doing: str) -> Iterator[None]:
        """Fail as a whole if a component does."""
        self._who = ""
        try:
            yield
        except FailedError as failure:
            status = self.judge(self._tell(failure))
            raise SimulationError(self.describe_failure(doing, status)) from None

    def _own(self, memory: Memory) -> SavedState:
        saved = _SystemState(memory)
        self._saved_states.add(saved)
        return saved

    def restore_state(self, state: SavedState) -> None:
        """See ``Instance.restore_state``."""
        if self.phase is Phase.DEAD:
            raise SimulationError(f"{self._log.instance_name}: no restore after a fatal error")
        for part in self._parts.all:
            part.started = True
        with self._failing("restoring the FMU state"):
            self.go_back(state)
        self.phase = Phase.STEPPING

    def serialize(self, state: SavedState) -> bytes:
        """See ``Instance.serialize``; the native pool writes the same."""
        memory: Memory = state.memory
        data = [memory.inputs, memory.outputs, struct.pack("=d", memory.fresh)]
        for index, own in enumerate(memory.states):
            with self._failing("serializing a state"), self._parts.blaming(index):
                own_data = self._parts.all[index].instance.serialize(own)
            data += [struct.pack("=Q", len(own_data)), own_data]
        return b"".join(data)

    def deserialize(self, data: bytes) -> SavedState:
        """See ``Instance.deserialize``."""
        inputs, outputs = 8 * self._layout.number_of_inputs, 8 * self._layout.number_of_outputs
        place = inputs + outputs + 8
        states = []
        try:
            fresh = struct.unpack("=d", data[place - 8 : place])[0] != 0.0
            for index, part in enumerate(self._parts.all):
                size = struct.unpack("=Q", data[place : place + 8])[0]
                with self._failing("deserializing a state"), self._parts.blaming(index):
                    states.append(part.instance.deserialize(data[place + 8 : place + 8 + size]))
                place += 8 + size
        except struct.error:
            place = -1
        if place != len(data):
            self.check("deserializing a state", Status.ERROR)
        slots = data[:inputs], data[inputs : inputs + outputs]
        return self._own(Memory(*slots, fresh, tuple(states)))


class _SystemState(SavedState):
    """The owner of the states of all components."""

    release: Any

    def __init__(self, memory: Memory) -> None:
        self.memory = memory
        self.release = weakref.finalize(self, _release, memory.states)


def _release(states: tuple[SavedState, ...]) -> None:
    for state in states:
        state.release()
