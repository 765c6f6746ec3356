"""The pool in Python: FMPy's functions with buffers made beforehand, one instance after another."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fmugym.archive.description import Variable
from fmugym.archive.fmu import LoadableFMU
from fmugym.errors import FMUGymError, SimulationError, printable
from fmugym.fmi.access import Access
from fmugym.fmi.instance import Instance, SavedState
from fmugym.fmi.library import Library
from fmugym.fmi.status import Phase, Status
from fmugym.pool.base import FloatArray, MaskArray, PoolSpec, StatusArray
from fmugym.pool.health import Column, CountedPool, HealthArray, no_counts, note
from fmugym.pool.leaks import watch_leaks

__all__ = ["PythonPool"]


class PythonPool(CountedPool):
    """N instances stepped one after another; see ``Pool`` for the contract.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        counts: Where to count what is in ``health``, shape (N, HEALTH_COUNTS).

    Raises:
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """

    def __init__(
        self,
        fmu: LoadableFMU,
        spec: PoolSpec,
        num_instances: int,
        log: logging.Logger,
        *,
        counts: HealthArray | None = None,
    ) -> None:
        self.num_instances = num_instances
        self._spec = spec
        # One row an instance, so that the FMU reads and writes this memory without a copy.
        input_rows = np.zeros((num_instances, len(spec.inputs)))
        output_rows = np.zeros((num_instances, len(spec.outputs)))
        self.inputs, self.outputs = input_rows.T, output_rows.T
        self.statuses: StatusArray = np.zeros(num_instances, np.int8)
        self.observations = np.zeros((num_instances, spec.num_observed), np.float32)
        self._counts = no_counts(num_instances) if counts is None else counts
        self._library = Library(fmu, log)
        states = _States()
        try:
            self._slots = [
                _Slot(self._library, spec, input_rows[i], output_rows[i], self._counts[i], states)
                for i in range(num_instances)
            ]
        except BaseException:
            self._library.close()
            raise
        recycle = functools.partial(_recycle, self._slots)
        self._watch = watch_leaks(fmu, spec, self._counts, recycle, log)

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        reset = self._reset if self._watch is None else self._watch.around(self._reset)
        reset(variables, values, mask)
        return self.outputs, self.statuses

    def _reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> None:
        for index, slot in enumerate(self._slots):
            if mask is None or mask[index]:
                self._note(index, slot.reset(variables, values[:, index]))

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        if inputs is not None:
            np.copyto(self.inputs, inputs)
        for index, slot in enumerate(self._slots):
            if skip is None or not skip[index]:
                self._note(index, slot.step())
        if observations is not None:
            np.copyto(observations, self.outputs[: self._spec.num_observed].T, casting="same_kind")
        return self.outputs, self.statuses

    def _note(self, index: int, status: int) -> None:
        self.statuses[index] = status
        if status:
            note(self._counts[index], status)

    def step_own(self) -> int:
        """See ``Pool.step_own``."""
        self.step(None, None, self.observations)
        return int(np.count_nonzero(self.statuses > Status.WARNING))

    def save(self) -> list[_Snapshot]:
        """See ``Pool.save``."""
        return [slot.save() for slot in self._slots]

    def restore(
        self, snapshot: list[_Snapshot], mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.restore``."""
        chosen = [i for i in range(self.num_instances) if mask is None or mask[i]]
        if len(snapshot) != self.num_instances:
            raise SimulationError("the snapshot was taken from another pool")
        for index in chosen:
            self._slots[index].require_own(snapshot[index])
        for index in chosen:
            self._note(index, self._slots[index].restore(snapshot[index]))
        return self.outputs, self.statuses

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        return self._slots[index].failure

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        return np.stack([slot.read(variables) for slot in self._slots], axis=1)

    def _count_steps(self) -> None:
        for slot in self._slots:
            slot.count_steps()

    def _memory_growth(self) -> int:
        return 0 if self._watch is None else self._watch.growth

    def recycle(self) -> None:
        """Let each instance be replaced by a new one at its next reset."""
        _recycle(self._slots)

    def close(self) -> None:
        """See ``Pool.close``."""
        self._library.close()


def _recycle(slots: Sequence[_Slot]) -> None:
    for slot in slots:
        slot.is_due = True


@dataclass(frozen=True, eq=False)
class _Snapshot:
    instance: Instance
    state: SavedState
    count: int


class _States:
    """What the instances of a pool know of FMU states.

    Attributes:
        complete: Whether steps from a restored state were found to be the same; None before.
    """

    complete: bool | None = None


_REHEARSED = 3  # steps
_STEPPING = Phase.STEPPING
_WARNING = int(Status.WARNING)
_STATUSES = {Phase.FAILED: Status.ERROR, Phase.DEAD: Status.FATAL}


def _all_finite(values: list[float]) -> bool:
    total = sum(values)
    return total - total == 0.0 or all(map(math.isfinite, values))


def _is_fine(status: int) -> bool:
    return 0 <= status <= _WARNING


class _Slot:
    """One place of the pool: its instance, which is replaced when it is past mending."""

    def __init__(
        self,
        library: Library,
        spec: PoolSpec,
        input_row: FloatArray,
        output_row: FloatArray,
        counts: HealthArray,
        states: _States,
    ) -> None:
        self.failure = ""
        self._states = states
        self.is_due = False
        self._counts = counts
        self._count = self._counted = 0
        self._library = library
        self._spec = spec
        self._input_row, self._output_row = input_row, output_row
        self._step_size = spec.communication_step_size
        self._build()

    def _build(self) -> None:
        self._instance = self._library.instantiate()
        self._inputs = Access(self._instance, self._spec.inputs, self._input_row)
        self._outputs = Access(self._instance, self._spec.outputs, self._output_row)
        self._start_variables: tuple[Variable, ...] = ()
        self._start = Access(self._instance, ())
        self._start_key: tuple[tuple[Variable, ...], bytes] | None = None
        self._saved: SavedState | None = None
        self._good_outputs = self._output_row.tolist()

    def reset(self, variables: tuple[Variable, ...], values: FloatArray) -> int:
        """Start anew by the cheapest way that gives the same as a fresh instance.

        The state after initialization is kept once the same start values come a second time, after
        an episode with steps, and restored from then on; other start values take a reset and an
        initialization.
        """
        key = (variables, values.tobytes())
        stepped = self._count > self._spec.warm_up_steps * self._spec.substeps
        self.count_steps()
        self._counts[Column.RESETS] += 1
        self._counts[Column.RETRIED] = 0
        try:
            self._recycle_if_due()
            if not self._restored(key):
                self._initialize(variables, values)
                if not self._keeps_state(key, stepped):
                    self._initialize(variables, values)
        except FMUGymError as error:
            return self._failed(str(error))
        self._begin_counting_at(self._spec.warm_up_steps * self._spec.substeps)
        return self._read_outputs(Status.OK)

    def count_steps(self) -> None:
        """Let the counts have all steps until now."""
        self._counts[Column.STEPS] += self._count - self._counted
        self._counted = self._count

    def _begin_counting_at(self, count: int) -> None:
        self._count = self._counted = count

    def _recycle_if_due(self) -> None:
        """Memory that an instance has leaked may go with it."""
        is_due, self.is_due = self.is_due, False
        if is_due and self._instance.phase not in (Phase.DEAD, Phase.INSTANTIATED):
            self._counts[Column.RECYCLINGS] += 1
            self._replace()

    def _restored(self, key: tuple[tuple[Variable, ...], bytes]) -> bool:
        if self._saved is None or key != self._start_key or self._instance.phase is Phase.DEAD:
            return False
        try:
            self._instance.restore_state(self._saved)
        except SimulationError:  # a reset and an initialization may still do
            self._saved = None
        return self._saved is not None

    def _keeps_state(self, key: tuple[tuple[Variable, ...], bytes], stepped: bool) -> bool:
        """Keep the state if it will be of use; returns whether the instance may go on."""
        again = stepped and key == self._start_key
        self._start_key, self._saved = key, None
        if not again or not self._library.can_save_state or self._states.complete is False:
            return True
        self._saved = self._instance.save_state()
        if self._states.complete is None:
            self._states.complete = self._rehearse(self._saved)
            if not self._states.complete:
                self._saved = None
                return False
        return True

    def _rehearse(self, start: SavedState) -> bool:
        """Step twice from the kept state, with the inputs that were written last.

        An FMU may have left a part of its state out.
        """
        results = []
        if not _all_finite(self._input_row.tolist()):
            return False
        try:
            for _ in range(2):
                with self._instance.muted():
                    results.append(self._try_steps())
                self._instance.restore_state(start)
        except SimulationError:
            return False
        return results[0] == results[1]

    def _try_steps(self) -> bytes:
        """Set the inputs and step; returns the outputs."""
        before, values = self._count, b""
        self._instance.check("setting the inputs", self._inputs.set())
        access = Access(self._instance, self._spec.outputs)
        for _ in range(_REHEARSED):
            if not (_is_fine(self._advance()) and _is_fine(access.get())):
                raise SimulationError(self.failure)
            values += access.values.tobytes()
        self._count = before
        return values

    def _initialize(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        self._return_to_instantiated()
        if variables is not self._start_variables:
            self._start = Access(self._instance, variables)
            self._start_variables = variables
        self._start.values[:] = values
        spec = self._spec
        self._instance.initialize(
            spec.start_time, spec.stop_time, spec.tolerance, self._set_start_values
        )
        self._warm_up()

    def _return_to_instantiated(self) -> None:
        """Reset the instance, or replace it where it refuses or is past any reset."""
        if self._instance.phase is Phase.INSTANTIATED:
            return
        try:
            self._instance.reset()
        except SimulationError:
            self._replace()

    def _replace(self) -> None:
        self._counts[Column.REPLACEMENTS] += 1
        self._library.discard(self._instance)
        self._build()

    def _set_start_values(self) -> None:
        self._instance.check("setting the start values", self._start.set())
        for variable, text in self._spec.strings:
            self._instance.set_string(variable, text)

    def _warm_up(self) -> None:
        self._begin_counting_at(0)
        for _ in range(self._spec.warm_up_steps):
            status = self._advance()
            self._begin_counting_at(self._count)
            if not _is_fine(status):
                raise SimulationError(f"the warm-up failed: {self.failure}")

    def step(self) -> int:
        """Set the inputs, step, get the outputs."""
        if self._instance.phase is not _STEPPING:
            return self._failed("a step was asked for before a reset has mended the instance")
        inputs = self._input_row.tolist()
        if not _all_finite(inputs):
            return self._not_finite("inputs", self._spec.inputs, inputs)
        if self._spec.fault_retries:
            self._counts[Column.RETRIED] = 0
        status = self._inputs.set()
        if status and not _is_fine(status):
            return self._failed_call("setting the inputs", status)
        status = self._advance()
        if status and not _is_fine(status) and status != Status.TERMINATED:
            return status
        result = self._read_outputs(status)
        if result > _WARNING and result != Status.NOT_FINITE:  # the step may have been the last
            self._instance.forbid_steps()
        return result

    def _advance(self) -> int:
        spec, status = self._spec, 0
        do_step = self._step_with_retries if spec.fault_retries else self._instance.step
        for _ in range(spec.substeps):
            time = spec.communication_point(self._count)
            status = do_step(time, self._step_size)
            self._count += 1
            if status and not _is_fine(status):
                doing = f"the step at t = {time:g} s"
                self.failure = self._instance.describe_failure(doing, status)
                break
        return status

    def _step_with_retries(self, time: float, step_size: float) -> int:
        """Each try begins at the state before the first: from a discarded step none may go on."""
        instance = self._instance
        try:
            before = instance.save_state()
            status = instance.step(time, step_size)
            for exponent in range(1, self._spec.fault_retries + 1):
                if status != Status.DISCARD:
                    break
                instance.restore_state(before)
                self._counts[[Column.RETRIES, Column.RETRIED]] += 1
                status = self._step_in_parts(time, 2**exponent)
            before.release()
        except SimulationError:  # the state could not be saved or restored
            status = Status.DISCARD
            instance.forbid_steps()
        return _STATUSES.get(instance.phase, status)

    def _step_in_parts(self, time: float, parts: int) -> int:
        size, status = self._step_size / parts, 0
        for index in range(parts):
            status = self._instance.step(time + index * size, size)
            if status and not _is_fine(status):
                break
        return status

    def _read_outputs(self, status: int) -> int:
        """Read into the row; what is not finite is replaced by what was there before."""
        got = self._outputs.get()
        if got and not _is_fine(got):
            return self._failed_call("reading the outputs", got)
        values = self._output_row.tolist()
        if not _all_finite(values):
            self._output_row[:] = self._good_outputs
            return self._not_finite("outputs", self._spec.outputs, values)
        self._good_outputs = values
        return status

    def _not_finite(self, what: str, variables: Sequence[Variable], values: list[float]) -> int:
        pairs = zip(variables, values, strict=True)
        bad = (f"{v.name} = {value}" for v, value in pairs if not math.isfinite(value))
        self.failure = f"the {what} are not finite: {printable(', '.join(bad))}"
        return Status.NOT_FINITE

    def _failed_call(self, doing: str, status: int) -> int:
        status = self._instance.judge(status)
        self.failure = self._instance.describe_failure(doing, status)
        self._output_row[:] = self._good_outputs
        return status

    def _failed(self, reason: str) -> int:
        self.failure = reason
        return Status.FATAL if self._instance.phase is Phase.DEAD else Status.ERROR

    def save(self) -> _Snapshot:
        """Copy the FMU state and the time."""
        return _Snapshot(self._instance, self._instance.save_state(), self._count)

    def require_own(self, snapshot: _Snapshot) -> None:
        """Refuse a state of another instance, which FMUs accept silently."""
        if snapshot.instance is not self._instance:
            raise SimulationError("the snapshot is of another instance than this one")

    def restore(self, snapshot: _Snapshot) -> int:
        """Return to a state and its time."""
        self.count_steps()
        try:
            self._instance.restore_state(snapshot.state)
        except SimulationError as error:
            return self._failed(str(error))
        self._begin_counting_at(snapshot.count)
        return self._read_outputs(Status.OK)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """Read any variables now."""
        if not self._instance.can_read:
            raise SimulationError("nothing can be read before a reset has mended the instance")
        access = Access(self._instance, variables)
        self._instance.check("reading variables", access.get())
        return access.values
