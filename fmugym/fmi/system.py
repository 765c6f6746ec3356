"""Instances of systems: to their users they are instances of one FMU.

This does what ``native/system.c`` and its siblings do, operation by operation.
"""

from __future__ import annotations

import functools
import logging
import math
import struct
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.fmu import LoadableFMU
from fmugym.archive.variable import Variable
from fmugym.errors import FMULoadError, SimulationError
from fmugym.fmi.access import Access
from fmugym.fmi.chain import chained_jacobian
from fmugym.fmi.control import Repeatable, StepControl
from fmugym.fmi.instance import Initialize, Instance, SavedState, Span
from fmugym.fmi.kept import KeptStart
from fmugym.fmi.library import Library
from fmugym.fmi.log import Hearing, MessageLog
from fmugym.fmi.loops import NotSolvedError, solve_loop
from fmugym.fmi.solver import Solving
from fmugym.fmi.status import Phase, Status, failed_call, sane
from fmugym.systems.description import MASTER, PartVariable, SystemDescription
from fmugym.systems.layout import Layout, PartLayout, Route, array_key
from fmugym.systems.plan import Evaluation, Group

__all__ = ["SystemInstance", "SystemLibrary", "open_library"]

_GOOD: Final = (Status.OK, Status.WARNING)


class _FailedError(Exception):
    """A call of a component returned a status worse than a warning."""

    def __init__(self, status: int, who: str) -> None:
        super().__init__(status)
        self.status, self.who = status, who


def _scaled(gain: float, offset: float, value: float) -> float:
    return value if gain == 1.0 and offset == 0.0 else gain * value + offset


def _carried(source: _Part, route: Route, values: Iterable[float]) -> list[float]:
    """What a route carries. Values that are not finite must not reach other FMUs."""
    carried = []
    for value in values:
        if not math.isfinite(value):
            raise _FailedError(Status.NOT_FINITE, f"{source.label}, whose outputs are not finite")
        carried.append(_scaled(route.gain, route.offset, value))
    return carried


def _shared_out(routes: Iterable[Route], values: Sequence[float]) -> Iterator[Any]:
    """Each route with its part of the values of all."""
    first = 0
    for route in routes:
        yield route, values[first : first + route.count]
        first += route.count


class _Part:
    """The instance of one component.

    Args:
        layout: Its slots.
        instance: Of its FMU.
    """

    def __init__(self, layout: PartLayout, instance: Instance) -> None:
        self.layout, self.instance = layout, instance
        self.label = layout.label
        self.inputs = Access(instance, layout.inputs)
        self.outputs = Access(instance, layout.outputs)
        self.started = False
        self.forget()

    def renew(self, instance: Instance) -> None:
        """Go on with another instance."""
        self.instance, self.started = instance, False
        self.inputs = Access(instance, self.layout.inputs, self.inputs.values)
        self.outputs = Access(instance, self.layout.outputs, self.outputs.values)

    def forget(self) -> None:
        """Return the slots to the start values."""
        self.inputs.values[:] = self.layout.starts_of(self.layout.inputs)
        self.outputs.values[:] = 0.0

    def judge(self, status: int) -> None:
        """Raise for a bad status of a call.

        Raises:
            _FailedError: With the name of the component.
        """
        status = self.instance.judge(sane(status))
        if status not in _GOOD:
            raise _FailedError(status, self.label)

    def get(self, variables: Sequence[Variable]) -> list[float]:
        """Get a scalar, or some elements of an array."""
        access = Access(self.instance, variables)
        self.judge(access.get())
        return list(map(float, access.values))

    def set(self, variables: Sequence[Variable], values: Iterable[float]) -> None:
        """Set a scalar, or all elements of an array, or several of both."""
        access = Access(self.instance, variables, np.array(list(values), float))
        self.judge(access.set())

    def read(self) -> None:
        """Fill the slots of the outputs."""
        self.judge(self.outputs.get())

    def advance(self, time: float, step: float) -> bool:
        """Do the communication steps; returns whether the FMU has asked to stop."""
        count = self.layout.component.steps
        size = step / count
        for index in range(count):
            status = self.instance.step(time + index * size, size)
            if status == Status.TERMINATED:
                return True
            self.judge(status)
        return False


@dataclass(frozen=True, eq=False)
class _Memory:
    """What a system adds to a saved state: the slots of all parts, and the states of the parts."""

    inputs: bytes
    outputs: bytes
    fresh: bool
    states: tuple[SavedState, ...]


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
        self._resets, self._renew = resets, renew
        self._kept, self._life = KeptStart(), object()
        self._layout = layout
        self._description: SystemDescription = layout.description
        pairs = zip(layout.parts, instances, strict=True)
        self._parts = [_Part(part, instance) for part, instance in pairs]
        self._log = MessageLog(self._description.model_identifier, target)
        self._hearing, self.hears_all = Hearing(), True
        self.phase = Phase.INSTANTIATED
        self._saved_states: weakref.WeakSet[SavedState] = weakref.WeakSet()
        nominals = [nominal for _, nominal in layout.compared]
        control = layout.plan.control
        self._control = None if control is None else StepControl(control, nominals)
        self._fresh = False
        self._terminated = False
        self._pending: list[tuple[PartVariable, float | str]] | None = None
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
        return any(part.instance.can_say_more for part in self._parts)

    @property
    def is_silent(self) -> bool:
        """Whether no component has logged anything in this episode."""
        return all(part.instance.is_silent for part in self._parts)

    @property
    def hears_more_than_wanted(self) -> bool:
        """Whether a component logs everything although the logger drops most of it."""
        return any(part.instance.hears_more_than_wanted for part in self._parts)

    def begin_episode(self) -> None:
        """Forget the messages of the episode before."""
        for part in self._parts:
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
        said = "".join(part.instance._log.said() for part in self._parts)
        return f"{self._log.instance_name}: {failed_call(doing, status, self._who)}{said}"

    def _tell(self, failure: _FailedError) -> int:
        self._who = failure.who
        return failure.status

    def free(self) -> None:
        """Terminate and free the instances of all components."""
        for part in self._parts:
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
        except _FailedError as failure:
            return self._tell(failure)
        return Status.OK

    def _get_all(self, ends: Sequence[tuple[PartVariable, ...]], buffer: npt.NDArray[Any]) -> None:
        for index, behind in enumerate(ends):
            end = behind[0]
            buffer[index] = _scaled(end.gain, end.offset, self._get(end))

    def _get(self, end: PartVariable) -> float:
        if self._control is not None and end.part == MASTER:
            return float(self._control.statistics[end.variable.value_reference])
        part = self._parts[end.part]
        output, given = self._layout.output_slot(end), self._layout.input_slot(end)
        if output >= 0 and self._fresh:
            return float(part.outputs.values[output - part.layout.first_output])
        if given >= 0:
            return float(part.inputs.values[given - part.layout.first_input])
        return part.get((end.variable,))[0]

    def _set_all(self, ends: Sequence[tuple[PartVariable, ...]], buffer: npt.NDArray[Any]) -> None:
        for behind, value in zip(ends, buffer.tolist(), strict=True):
            for end in behind:
                self._set(end, _scaled(end.gain, end.offset, value))

    def _set(self, end: PartVariable, value: float) -> None:
        part = self._parts[end.part]
        given = self._layout.input_slot(end)
        if given >= 0:
            part.inputs.values[given - part.layout.first_input] = value
        if self._pending is not None:
            self._pending.append((end, value))
        elif given < 0:
            self._fresh = False
            self._set_alone(part, end.variable, value)

    def _set_alone(self, part: _Part, variable: Variable, value: float) -> None:
        """Set a scalar, or one element of an array, of which the others stay as they are."""
        whole = (variable if variable.array is None else variable.array).elements
        values = [value] if variable.array is None else part.get(whole)
        values[variable.place] = value
        part.set(whole, values)

    def set_string(self, variable: Variable, value: str) -> None:
        """See ``Instance.set_string``."""
        assert self._pending is not None
        ends = self._description.ends[variable.value_reference]
        self._pending += [(end, value) for end in ends]

    def get_string(self, variable: Variable) -> tuple[int, str]:
        """See ``Instance.get_string``."""
        end = self._description.ends[variable.value_reference][0]
        part = self._parts[end.part]
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
            self._initialize_parts(Span(start_time, stop_time, tolerance), set_start_values)
        except _FailedError as failure:
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

    def _initialize_parts(self, span: Span, set_start_values: Callable[[], None]) -> None:
        values = self._collected(set_start_values)
        key = KeptStart.key_of(span.start_time, values)
        if self._kept.known and key == self._kept.key:
            if self._has_begun_again(span, values):
                return
            self._give_up()
            values = self._collected(set_start_values)
        self._begin_all(span, values)
        if self._kept.next(key) and not self._has_kept_states():
            self._give_up()
            self._begin_all(span, self._collected(set_start_values))

    def _collected(self, set_start_values: Callable[[], None]) -> list[Any]:
        if self._control is not None:
            self._control.statistics[:] = 0.0
        for part in self._parts:
            part.forget()
        self._fresh = False
        self._pending = []
        try:
            set_start_values()
            return self._pending
        finally:
            self._pending = None

    def _begin_all(self, span: Span, values: list[Any]) -> None:
        self._kept.forget()
        for index in self._restoring:
            with self._restoring_part(index):
                self._reset_part(index)
        self._begin_from(0, span, values)
        self._refresh()

    # Some components return to the kept start, the others begin with their inputs of then.

    @property
    def _restoring(self) -> list[int]:
        pairs = enumerate(self._resets)
        return [i for i, method in pairs if method == "restore" and i not in self._kept.useless]

    @property
    def _others(self) -> list[int]:
        restoring = self._restoring
        return [index for index in range(len(self._parts)) if index not in restoring]

    def _has_begun_again(self, span: Span, values: list[Any]) -> bool:
        others = self._others
        try:
            self._restore_start()
            self._begin_others(others, span, values)
        except (_FailedError, SimulationError):
            return False
        return not self._blamed()

    def _blamed(self) -> bool:
        """Restore those no more whose outputs are others than then; returns whether any are."""
        now, then = (np.frombuffer(slots) for slots in (self._slots()[1], self._kept.slots[1]))
        if now.tobytes() == then.tobytes():
            return False
        found = []
        for index in self._restoring:
            part = self._parts[index].layout
            place = slice(part.first_output, part.first_output + len(part.outputs))
            if now[place].tobytes() != then[place].tobytes():
                found.append(index)
        self._kept.useless.update(found or range(len(self._parts)))
        return True

    def _restore_start(self) -> None:
        for index in self._restoring:
            with self._restoring_part(index):
                self._restore_part(index, self._kept.states[index])
        self._kept.stepped = False
        self._put_inputs(self._kept.slots[0])

    @contextmanager
    def _restoring_part(self, index: int) -> Iterator[None]:
        """Restore a component no more that fails in this."""
        try:
            yield
        except BaseException:
            self._kept.useless.add(index)
            raise

    def _begin_others(self, indices: Iterable[int], span: Span, values: list[Any]) -> None:
        for index in indices:
            self._begin(index, span, values, functools.partial(self._set_links, index))
        self._refresh()

    def _set_links(self, index: int) -> None:
        part = self._parts[index]
        for route in self._layout.routes:
            if route.target_part == index:
                first = route.target - part.layout.first_input
                self._write_target(route, part.inputs.values[first : first + route.count].tolist())

    def _has_kept_states(self) -> bool:
        try:
            for index in self._restoring:
                with self._restoring_part(index):
                    self._kept.states[index] = self._save_part(index)
        except _FailedError:
            return False
        self._kept.slots, self._kept.known = self._slots(), True
        return True

    def _give_up(self) -> None:
        """Return all that do not restore to where they were made."""
        self._kept.forget()
        for index in self._others:
            self._reset_part(index)

    def _begin_from(self, index: int, span: Span, values: list[Any]) -> None:
        """Begin with this part and all that follow, then exchange values."""
        while index < len(self._parts) and not self._parts[index].layout.has_mode:
            index += 1
        if index == len(self._parts):
            self._exchange_all(span, values)
        else:
            self._begin(index, span, values, lambda: self._begin_from(index + 1, span, values))

    def _begin(
        self, index: int, span: Span, values: list[Any], exchange: Callable[[], None] | None
    ) -> None:
        part = self._parts[index]
        part.started = True
        part.instance.exchange = exchange
        try:
            part.instance.initialize(*span, lambda: self._set_starts(index, values))
        except SimulationError:
            status = Status.FATAL if part.instance.phase is Phase.DEAD else Status.ERROR
            raise _FailedError(status, part.label) from None
        finally:
            part.instance.exchange = None

    def _set_starts(self, index: int, values: list[Any]) -> None:
        """What is set for this simulation wins over what the system says."""
        part = self._parts[index]
        starts = part.layout.starts
        numbers = [(v, value) for v, value in starts if not isinstance(value, str)]
        part.set([v for v, _ in numbers], [value for _, value in numbers])
        for variable, value in starts:
            if isinstance(value, str):
                part.instance.set_string(variable, value)
        self._set_pending(part, [(end, value) for end, value in values if end.part == index])
        if not part.layout.has_mode:
            part.judge(part.inputs.set())

    def _set_pending(self, part: _Part, values: list[tuple[PartVariable, Any]]) -> None:
        arrays: dict[Any, list[tuple[int, float]]] = {}
        for end, value in values:
            if end.variable.array is not None:
                arrays.setdefault(array_key(end), []).append((end.variable.place, value))
        for end, value in values:
            if isinstance(value, str):
                part.instance.set_string(end.variable, value)
            elif end.variable.array is None:
                part.set((end.variable,), (value,))
            elif array_key(end) in arrays:
                self._set_array(part, end, arrays.pop(array_key(end)))

    def _set_array(
        self, part: _Part, end: PartVariable, elements: Iterable[tuple[int, float]]
    ) -> None:
        """Set some elements of an array; the others start with what the system says."""
        whole = self._layout.arrays[array_key(end)][1].elements
        given = self._layout.input_slot(end)
        if given >= 0:
            values = list(part.inputs.values[part.layout.span_of(given - part.layout.first_input)])
        else:
            values = part.layout.starts_of(whole)
        for place, value in elements:
            values[place] = value
        part.set(whole, values)

    def _exchange_all(self, span: Span, values: list[Any]) -> None:
        def begin_if_old(index: int) -> None:
            part = self._parts[index]
            if not part.layout.has_mode and not part.started:
                self._begin(index, span, values, None)

        for evaluation in self._layout.plan.initialization:
            self._evaluate(evaluation, begin_if_old)
        for index in range(len(self._parts)):
            begin_if_old(index)

    def _evaluate(self, evaluation: Evaluation, begin_if_old: Callable[[int], None]) -> None:
        routes = [self._layout.routes[i] for i in self._layout.routes_of(evaluation)]
        if evaluation.loop is None:
            for route in routes:
                self._write_target(route, self._read_source(route, begin_if_old))
            return

        def read_all() -> list[float]:
            return [x for route in routes for x in self._read_source(route, begin_if_old)]

        def evaluate(x: list[float]) -> list[float]:
            for route, values in _shared_out(routes, x):
                self._write_target(route, values)
            return read_all()

        x = read_all()
        try:
            solve_loop(evaluation.loop, x, evaluate)
        except NotSolvedError:
            label = self._layout.loop_label(route.source_part for route in routes)
            raise _FailedError(Status.DISCARD, label) from None

    def _read_source(self, route: Route, begin_if_old: Callable[[int], None]) -> list[float]:
        begin_if_old(route.source_part)
        part = self._parts[route.source_part]
        first = route.source - part.layout.first_output
        values = part.get(part.layout.outputs[first : first + route.count])
        return _carried(part, route, values)

    def _write_target(self, route: Route, values: Sequence[float]) -> None:
        """Set inputs. An element of an array is set with the others, which stay as they are.

        FMI forbids to set inputs with clocks in Initialization Mode: they get their values in
        steps.
        """
        part = self._parts[route.target_part]
        self._take(route, values)
        place = route.target - part.layout.first_input
        if part.started and not part.layout.waits_for_clock(part.layout.inputs[place]):
            span = part.layout.span_of(place)
            part.set(part.layout.inputs[span], part.inputs.values[span])

    def _refresh(self) -> None:
        for part in self._parts:
            part.read()
        self._fresh = True

    # Steps

    def _step(self, time: float, step_size: float) -> int:
        self._who, self._terminated = "", False
        self._kept.stepped = True
        try:
            if self._control is not None:
                status = self._control.step(self, time, step_size)
                return self.judge_step(status) if status else status
            self._step_all(time, step_size)
        except _FailedError as failure:
            return self.judge_step(self._tell(failure))
        return self.judge_step(Status.TERMINATED) if self._terminated else Status.OK

    # What the estimate of errors needs

    def keep(self) -> SavedState:
        """See ``Repeatable.keep``."""
        states = tuple(self._save_part(index) for index in range(len(self._parts)))
        return self._own(_Memory(*self._slots(), self._fresh, states))

    def go_back(self, state: Any) -> None:
        """See ``Repeatable.go_back``."""
        for index, own in enumerate(state.memory.states):
            self._restore_part(index, own)
        self._put_slots(state.memory)

    def try_step(self, time: float, size: float) -> int:
        """See ``Repeatable.try_step``."""
        self._terminated = False
        try:
            self._step_all(time, size)
        except _FailedError as failure:
            if failure.status not in (Status.DISCARD, Status.NOT_FINITE):
                raise
            return self._tell(failure)
        return Status.TERMINATED if self._terminated else Status.OK

    def sources(self) -> npt.NDArray[np.float64]:
        """See ``Repeatable.sources``."""
        outputs = np.frombuffer(self._slots()[1])
        return outputs[[place for place, _ in self._layout.compared]]

    def judge_step(self, status: int) -> int:
        """See ``Instance.judge_step``; values for other components may be no numbers."""
        if status != Status.NOT_FINITE:
            return super().judge_step(status)
        self.forbid_steps()
        return status

    def _step_all(self, time: float, step_size: float) -> None:
        if not self._fresh:
            self._refresh()
        self._fresh = False
        if self._layout.plan.master == "jacobi":
            for route in self._layout.routes:
                self._carry(route)
        for group in self._layout.plan.groups:
            self._step_group(group, time, step_size)
        for part in self._parts:
            part.inputs.values[list(part.layout.clocks)] = 0.0
        self._fresh = True

    def _carried(self, route: Route) -> list[float]:
        part = self._parts[route.source_part]
        first = route.source - part.layout.first_output
        return _carried(part, route, part.outputs.values[first : first + route.count].tolist())

    def _take(self, route: Route, values: Sequence[float]) -> None:
        part = self._parts[route.target_part]
        first = route.target - part.layout.first_input
        part.inputs.values[first : first + route.count] = values

    def _carry(self, route: Route) -> None:
        self._take(route, self._carried(route))

    def _carry_to(self, index: int) -> None:
        for route in self._layout.routes:
            if route.target_part == index:
                self._carry(route)

    def _step_group(self, group: Group, time: float, step_size: float) -> None:
        is_jacobi = self._layout.plan.master == "jacobi"
        if group.loop is not None and not is_jacobi:
            self._solve(group, time, step_size)
            return
        for index in self._layout.parts_of(group):
            if not is_jacobi:
                self._carry_to(index)
            self._step_part(index, time, step_size)

    def _step_part(self, index: int, time: float, step_size: float) -> None:
        """If the FMU asks to stop, the others do their step all the same."""
        part = self._parts[index]
        part.judge(part.inputs.set())
        self._terminated |= part.advance(time, step_size)
        part.read()

    def _solve(self, group: Group, time: float, step_size: float) -> None:
        """Repeat the steps of the components of a loop from the state before the step."""
        assert group.loop is not None
        indices = self._layout.parts_of(group)
        routes = [self._layout.routes[i] for i in self._layout.inner_routes(group)]
        for index in indices:
            self._carry_to(index)
        x = [value for route in routes for value in self._carried(route)]
        was_terminated = self._terminated
        before = [self._save_part(index) for index in indices]
        moved = False

        def evaluate(x: list[float]) -> list[float]:
            nonlocal moved
            if moved:
                for index, state in zip(indices, before, strict=True):
                    self._restore_part(index, state)
            moved = True
            for route, values in _shared_out(routes, x):
                self._take(route, values)
            for index in indices:
                self._step_part(index, time, step_size)
            return [value for route in routes for value in self._carried(route)]

        try:
            solve_loop(group.loop, x, evaluate)
        except NotSolvedError:
            raise _FailedError(Status.DISCARD, self._layout.loop_label(indices)) from None
        finally:
            for state in before:
                state.release()
        self._terminated |= was_terminated

    def jacobian(
        self, unknowns: Sequence[Variable], knowns: Sequence[Variable]
    ) -> npt.NDArray[np.float64]:
        """See ``Instance.jacobian``; the derivatives of the components make those of the system."""
        self._require(Phase.STEPPING, "differentiate")
        behind = [
            [self._layout.ends_of(variable) for variable in some] for some in (unknowns, knowns)
        ]
        return chained_jacobian(
            self._layout,
            lambda part, of, by: self._parts[part].instance.jacobian(of, by),
            *behind,
        )

    # States and resets

    def _save_part(self, index: int) -> SavedState:
        part = self._parts[index]
        try:
            return part.instance.save_state()
        except SimulationError:
            raise _FailedError(self._status_of(part), part.label) from None

    def _restore_part(self, index: int, state: SavedState) -> None:
        part = self._parts[index]
        try:
            part.instance.restore_state(state)
        except SimulationError:
            raise _FailedError(self._status_of(part), part.label) from None

    def _status_of(self, part: _Part) -> int:
        return Status.FATAL if part.instance.phase is Phase.DEAD else Status.ERROR

    def reset(self) -> None:
        """See ``Instance.reset``."""
        if self.phase is Phase.DEAD:
            raise SimulationError(
                f"{self._log.instance_name}: no reset is legal after a fatal error"
            )
        for index in self._others:
            self._reset_part(index)
        self.phase = Phase.INSTANTIATED

    def _reset_part(self, index: int) -> None:
        part = self._parts[index]
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
        states = tuple(part.instance.save_state() for part in self._parts)
        memory = _Memory(*self._slots(), self._fresh, states)
        return self._own(memory)

    def _slots(self) -> tuple[bytes, bytes]:
        statistics = b"" if self._control is None else self._control.statistics.tobytes()
        return (
            b"".join(part.inputs.values.tobytes() for part in self._parts),
            b"".join(part.outputs.values.tobytes() for part in self._parts) + statistics,
        )

    def _own(self, memory: _Memory) -> SavedState:
        saved = _SystemState(memory)
        self._saved_states.add(saved)
        return saved

    def restore_state(self, state: SavedState) -> None:
        """See ``Instance.restore_state``."""
        if self.phase is Phase.DEAD:
            raise SimulationError(f"{self._log.instance_name}: no restore after a fatal error")
        memory: _Memory = state.memory
        for part, own in zip(self._parts, memory.states, strict=True):
            part.started = True
            part.instance.restore_state(own)
        self._put_slots(memory)
        self.phase = Phase.STEPPING

    def _put_slots(self, memory: _Memory) -> None:
        self._put_inputs(memory.inputs)
        outputs = np.frombuffer(memory.outputs)
        for part in self._parts:
            first = part.layout.first_output
            part.outputs.values[:] = outputs[first : first + len(part.layout.outputs)]
        if self._control is not None:
            self._control.statistics[:] = outputs[self._layout.first_statistic :]
        self._fresh = memory.fresh

    def _put_inputs(self, data: bytes) -> None:
        inputs = np.frombuffer(data)
        for part in self._parts:
            first = part.layout.first_input
            part.inputs.values[:] = inputs[first : first + len(part.layout.inputs)]

    def serialize(self, state: SavedState) -> bytes:
        """See ``Instance.serialize``; the native pool writes the same."""
        memory: _Memory = state.memory
        data = [memory.inputs, memory.outputs, struct.pack("=d", memory.fresh)]
        for part, own in zip(self._parts, memory.states, strict=True):
            own_data = part.instance.serialize(own)
            data += [struct.pack("=Q", len(own_data)), own_data]
        return b"".join(data)

    def deserialize(self, data: bytes) -> SavedState:
        """See ``Instance.deserialize``."""
        inputs, outputs = 8 * self._layout.number_of_inputs, 8 * self._layout.number_of_outputs
        place = inputs + outputs + 8
        states = []
        try:
            fresh = struct.unpack("=d", data[place - 8 : place])[0] != 0.0
            for part in self._parts:
                size = struct.unpack("=Q", data[place : place + 8])[0]
                states.append(part.instance.deserialize(data[place + 8 : place + 8 + size]))
                place += 8 + size
        except struct.error:
            place = -1
        if place != len(data):
            self.check("deserializing a state", Status.ERROR)
        slots = data[:inputs], data[inputs : inputs + outputs]
        return self._own(_Memory(*slots, fresh, tuple(states)))


class _SystemState(SavedState):
    """The owner of the states of all components."""

    release: Any

    def __init__(self, memory: _Memory) -> None:
        self.memory = memory
        self.release = weakref.finalize(self, _release, memory.states)


def _release(states: tuple[SavedState, ...]) -> None:
    for state in states:
        state.release()


class SystemLibrary(Library):
    """The libraries of the components of a system.

    Args:
        fmu: The system; extracted if necessary, and closed with the libraries.
        layout: The slots and routes.
        target: The logger for the messages of all instances.
        solving: See ``Library``.
        resets: See ``SystemInstance``; empty if all components are reset.

    Raises:
        FMULoadError: If a library cannot be loaded.
    """

    def __init__(
        self,
        fmu: LoadableFMU,
        layout: Layout,
        target: logging.Logger,
        solving: Solving | None,
        resets: Sequence[str] = (),
    ) -> None:
        self._resets = resets or ("reset",) * len(layout.parts)
        self.close: Any
        self._system, self._layout, self._target = fmu, layout, target
        self._libraries: list[Library] = []
        self.can_save_state = fmu.description.capabilities.can_get_and_set_fmu_state
        self._instances: list[SystemInstance] = []
        self.close = weakref.finalize(self, _close, self._instances, self._libraries, fmu)
        try:
            for part, known in zip(fmu.parts, layout.parts, strict=True):
                self._libraries.append(_load(part, known, target, solving))
        except BaseException:
            self.close()
            raise

    def instantiate(self, *, hear_all: bool = False) -> Instance:
        """See ``Library.instantiate``."""
        if not self.close.alive:
            raise SimulationError(f"{self._system.path.name} is closed")
        made: list[Instance] = []
        try:
            for part, library in zip(self._layout.parts, self._libraries, strict=True):
                made.append(_instantiate(library, part.label, hear_all))
        except BaseException:
            for instance in made:
                instance.free()
            raise
        renew = functools.partial(self._renewed, hear_all=hear_all)
        instance = SystemInstance(self._layout, made, self._target, self._resets, renew)
        self._instances.append(instance)
        return instance

    def _renewed(self, index: int, old: Instance, *, hear_all: bool) -> Instance:
        library, label = self._libraries[index], self._layout.parts[index].label
        library.discard(old)
        return _instantiate(library, label, hear_all)

    def discard(self, instance: Instance) -> None:
        """See ``Library.discard``."""
        assert isinstance(instance, SystemInstance)
        if instance in self._instances:
            self._instances.remove(instance)
        instance.free()


def _load(
    part: LoadableFMU, layout: PartLayout, target: logging.Logger, solving: Solving | None
) -> Library:
    if part.is_apart:
        raise FMULoadError(
            f"{layout.label}: it runs in a process of its own, which only the C extension can give "
            "it"
        )
    ramps = tuple(variable.value_reference for variable in layout.ramped)
    try:
        return Library(part, target, None if solving is None else replace(solving, ramps=ramps))
    except FMULoadError as error:
        raise FMULoadError(f"{layout.label}: {error}") from None


def _instantiate(library: Library, label: str, hear_all: bool) -> Instance:
    try:
        return library.instantiate(hear_all=hear_all)
    except FMULoadError as error:
        raise FMULoadError(f"{label}: {error}") from None


def _close(instances: list[SystemInstance], libraries: list[Library], fmu: LoadableFMU) -> None:
    while instances:
        instances.pop().free()
    for library in libraries:
        library.close()
    fmu.close()


def open_library(
    fmu: LoadableFMU,
    target: logging.Logger,
    solving: Solving | None,
    inputs: Sequence[Variable],
    outputs: Sequence[Variable],
    resets: Sequence[str] = (),
) -> Library:
    """Load an FMU or a system.

    Args:
        fmu: The FMU or system.
        target: See ``Library``.
        solving: See ``Library``.
        inputs: The variables that each step sets.
        outputs: The variables that are read after each step.
        resets: See ``SystemLibrary``.

    Raises:
        FMULoadError: As ``Library``.
    """
    description = fmu.description
    if not isinstance(description, SystemDescription):
        return Library(fmu, target, solving)
    ramps = () if solving is None else solving.ramps
    ramped = [variable for variable in inputs if variable.value_reference in ramps]
    layout = Layout(description, inputs, outputs, ramped)
    return SystemLibrary(fmu, layout, target, solving, resets)
