"""The pool in Python: it calls FMPy's functions with prepared buffers, instance by instance."""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from fmugym.archive.loadable import LoadableFMU
from fmugym.archive.variable import Variable
from fmugym.errors import SimulationError
from fmugym.fmi.log import fmu_calls
from fmugym.fmi.status import Status
from fmugym.fmi.system_library import open_library
from fmugym.pool.arithmetic import restore_arithmetic
from fmugym.pool.base import FloatArray, MaskArray, PoolSpec, StatusArray
from fmugym.pool.bundle import Bundle, IndexArray, Record, joined
from fmugym.pool.health import HealthArray, no_counts, note
from fmugym.pool.leaks import watch_leaks
from fmugym.pool.mark import END, RESET, STEP, Mark, calling
from fmugym.pool.saving import SavingPool, Serialized
from fmugym.pool.slot import Slot, Snapshot
from fmugym.pool.spec import ResetMethod

__all__ = ["PythonPool"]

_WARNING: Final = int(Status.WARNING)
"""An enumeration's member has Python code, in which numpy drops what a signal handler raises."""


class PythonPool(SavingPool):
    """N instances stepped one after another; see ``Pool`` for the contract.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.
        counts: Gets the counts of ``health``, shape (N, HEALTH_COUNTS).
        mark: Where a crash inside the FMU is noted.

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
        mark: Mark | None = None,
    ) -> None:
        self.num_instances = num_instances
        self._spec = spec = spec.fitting(fmu.description)
        # One row per instance, so that the FMU reads and writes this memory without a copy.
        input_rows = np.zeros((num_instances, len(spec.inputs)))
        output_rows = np.zeros((num_instances, len(spec.outputs)))
        self.inputs, self.outputs = input_rows.T, output_rows.T
        self.statuses: StatusArray = np.zeros(num_instances, np.int8)
        self.observations = np.zeros((num_instances, spec.num_observed), np.float32)
        self._counts = no_counts(num_instances) if counts is None else counts
        self._mark = mark
        self._stepping, self._resetting = calling(mark, STEP), calling(mark, RESET)
        with self._resetting:
            self._library = open_library(
                fmu, log, spec.solving, spec.inputs, spec.outputs, spec.component_resets
            )
        try:
            with fmu_calls, self._resetting:
                self._slots = [
                    Slot(self._library, spec, input_rows[i], output_rows[i], self._counts[i])
                    for i in range(num_instances)
                ]
        except BaseException:
            self._library.close()
            raise
        finally:
            restore_arithmetic()
        if self._prepare_saving(fmu.description, spec):
            self._keep_records()
        recycle = functools.partial(_recycle, self._slots)
        self._watch = watch_leaks(fmu, spec, self._counts, recycle, log)

    def _reset_some(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> None:
        if self._watch is None:
            self._reset_slots(variables, values, mask)
        else:
            self._watch.call(self._reset_slots, variables, values, mask)

    def _reset_slots(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None
    ) -> None:
        began = time.perf_counter()
        with fmu_calls, self._resetting:
            for index, slot in enumerate(self._slots):
                if mask is None or mask[index]:
                    self._note(index, slot.reset(variables, values[:, index]))
        self._note_reset(variables, values, mask, time.perf_counter() - began)

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        if inputs is not None:
            np.copyto(self.inputs, inputs)
        began = time.perf_counter() if self._is_recording else 0.0
        with fmu_calls, self._stepping:
            for index, slot in enumerate(self._slots):
                if skip is None or not skip[index]:
                    self._note(index, slot.step())
            if observations is not None:
                observed = self.outputs[: self._spec.num_observed]
                np.copyto(observations, observed.T, casting="same_kind")
        if self._is_recording:
            self._note_step(skip, time.perf_counter() - began)
        return self.outputs, self.statuses

    def _note(self, index: int, status: int) -> None:
        restore_arithmetic()
        self.statuses[index] = status
        if status:
            note(self._counts[index], status)

    def step_own(self) -> int:
        """See ``Pool.step_own``."""
        self.step(None, None, self.observations)
        return int(np.count_nonzero(self.statuses > _WARNING))

    def save(self) -> list[Snapshot]:
        """See ``Pool.save``."""
        if self._watch is not None:
            self._watch.has_snapshots = True
        return self._copy_all()

    def _copy_all(self) -> list[Snapshot]:
        """See ``SavingPool._copy_all``."""
        try:
            with fmu_calls:
                return [slot.save() for slot in self._slots]
        finally:
            restore_arithmetic()

    def restore(
        self, snapshot: list[Snapshot], mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.restore``."""
        chosen = [i for i in range(self.num_instances) if mask is None or mask[i]]
        if len(snapshot) != self.num_instances:
            raise SimulationError("the snapshot was taken from another pool")
        for index in chosen:
            self._slots[index].require_own(snapshot[index])
        self._drop_recording()
        with fmu_calls:
            for index in chosen:
                self._note(index, self._slots[index].restore(snapshot[index]))
        return self.outputs, self.statuses

    def write(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        """See ``Pool.write``."""
        try:
            with fmu_calls:
                for index, slot in enumerate(self._slots):
                    slot.write(variables, values[:, index])
        finally:
            restore_arithmetic()

    def serialize_states(self, indices: IndexArray) -> Serialized:
        """See ``SavingPool.serialize_states``."""
        chosen = [self._slots[index] for index in indices.tolist()]
        try:
            with fmu_calls:
                data, ends = joined([slot.serialize() for slot in chosen])
        finally:
            restore_arithmetic()
        steps = np.array([slot.count for slot in chosen], np.int64)
        return data, ends, steps, np.array([slot.start_time for slot in chosen], np.float64)

    def deserialize_states(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> None:
        """See ``SavingPool.deserialize_states``."""
        times = bundle.start_times
        with fmu_calls:
            for source, index in zip(sources.tolist(), indices.tolist(), strict=True):
                state, outputs = bundle.state(source), bundle.outputs[:, source]
                count, start = int(bundle.steps[source]), float(times[source])
                self._note(index, self._slots[index].deserialize(state, count, start, outputs))

    def record_of(self, index: int) -> Record | None:
        """See ``SavingPool.record_of``."""
        return self._slots[index].record

    def replace_record(self, index: int, record: Record) -> None:
        """See ``SavingPool.replace_record``."""
        self._slots[index].replace_record(record)

    def _keep_records(self) -> None:
        for slot in self._slots:
            slot.keeps_record = True

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        return self._slots[index].failure

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        try:
            with fmu_calls:
                return np.stack([slot.read(variables) for slot in self._slots], axis=1)
        finally:
            restore_arithmetic()

    def differentiate(
        self, unknowns: tuple[Variable, ...], knowns: tuple[Variable, ...]
    ) -> FloatArray:
        """See ``Pool.differentiate``."""
        try:
            with fmu_calls:
                parts = [slot.differentiate(unknowns, knowns) for slot in self._slots]
        finally:
            restore_arithmetic()
        return np.stack(parts, axis=2)

    def knows_start(self, index: int, variables: tuple[Variable, ...], values: FloatArray) -> bool:
        """See ``AttendedPool.knows_start``."""
        return self._slots[index].knows_start(variables, values)

    def _count_steps(self) -> None:
        for slot in self._slots:
            slot.count_steps()

    def _memory_growth(self) -> int:
        return 0 if self._watch is None else self._watch.growth

    def begin_by(self, method: ResetMethod) -> bool:
        """See ``Pool.begin_by``; the library cannot be loaded anew."""
        if method not in (ResetMethod.RESET, ResetMethod.INSTANCE):
            return False
        self._spec = self._spec.beginning_by(method)
        for slot in self._slots:
            slot.begin_by(method)
        self._keep_records()
        self._mistrust_states()
        return True

    def recycle(self) -> None:
        """Let each instance be replaced by a new one at its next reset."""
        _recycle(self._slots)

    def close(self) -> None:
        """See ``Pool.close``."""
        try:
            with fmu_calls, calling(self._mark, END):
                self._library.close()
        finally:
            restore_arithmetic()
            self._return_seats()


def _recycle(slots: Sequence[Slot]) -> None:
    for slot in slots:
        slot.is_due = True
