"""The pool in Python: FMPy's functions with buffers made beforehand, one instance after another."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fmugym.adapters import Access, Instance, Library, Phase, SavedState, Status
from fmugym.archive import FMU
from fmugym.errors import FMUGymError, SimulationError
from fmugym.model_description import Variable
from fmugym.pool.base import FloatArray, MaskArray, PoolSpec, StatusArray

__all__ = ["PythonPool"]


class PythonPool:
    """N instances stepped one after another; see ``Pool`` for the contract.

    Args:
        fmu: The FMU; closed with the pool.
        spec: What to do at each reset and step.
        num_instances: N.
        log: The logger that gets the FMU's messages.

    Raises:
        FMULoadError: If the FMU cannot be loaded or instantiated.
    """

    def __init__(self, fmu: FMU, spec: PoolSpec, num_instances: int, log: logging.Logger) -> None:
        self.num_instances = num_instances
        self._spec = spec
        # One row an instance, so that the FMU reads and writes this memory without a copy.
        input_rows = np.zeros((num_instances, len(spec.inputs)))
        output_rows = np.zeros((num_instances, len(spec.outputs)))
        self.inputs, self.outputs = input_rows.T, output_rows.T
        self.statuses: StatusArray = np.zeros(num_instances, np.int8)
        self.observations = np.zeros((num_instances, spec.num_observed), np.float32)
        self._library = Library(fmu, log)
        try:
            self._slots = [
                _Slot(self._library, spec, input_rows[index], output_rows[index])
                for index in range(num_instances)
            ]
        except BaseException:
            self._library.close()
            raise

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        for index, slot in enumerate(self._slots):
            if mask is None or mask[index]:
                self.statuses[index] = slot.reset(variables, values[:, index])
        return self.outputs, self.statuses

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
                self.statuses[index] = slot.step()
        if observations is not None:
            np.copyto(observations, self.outputs[: self._spec.num_observed].T, casting="same_kind")
        return self.outputs, self.statuses

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
            self.statuses[index] = self._slots[index].restore(snapshot[index])
        return self.outputs, self.statuses

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        return self._slots[index].failure

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        return np.stack([slot.read(variables) for slot in self._slots], axis=1)

    def close(self) -> None:
        """See ``Pool.close``."""
        self._library.close()


@dataclass(frozen=True, eq=False)
class _Snapshot:
    instance: Instance
    state: SavedState
    count: int


_STEPPING = Phase.STEPPING
_WARNING = int(Status.WARNING)


def _is_fine(status: int) -> bool:
    return 0 <= status <= _WARNING


class _Slot:
    """One place of the pool: its instance, which is replaced when it is past mending."""

    def __init__(
        self, library: Library, spec: PoolSpec, input_row: FloatArray, output_row: FloatArray
    ) -> None:
        self.failure = ""
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
        self._count = 0
        self._good_outputs = self._output_row.tolist()

    def reset(self, variables: tuple[Variable, ...], values: FloatArray) -> int:
        """Start anew by the cheapest way that gives the same as a fresh instance.

        The state after initialization is kept once the same start values come a second time, and
        restored from then on; other start values take a reset and an initialization.
        """
        key = (variables, values.tobytes())
        try:
            if not self._restored(key):
                self._initialize(variables, values)
                self._keep_state(key)
        except FMUGymError as error:
            return self._failed(str(error))
        self._count = self._spec.warm_up_steps * self._spec.substeps
        return self._read_outputs(Status.OK)

    def _restored(self, key: tuple[tuple[Variable, ...], bytes]) -> bool:
        if self._saved is None or key != self._start_key or self._instance.phase is Phase.DEAD:
            return False
        try:
            self._instance.restore_state(self._saved)
        except SimulationError:  # a reset and an initialization may still do
            self._saved = None
        return self._saved is not None

    def _keep_state(self, key: tuple[tuple[Variable, ...], bytes]) -> None:
        again = key == self._start_key
        self._start_key, self._saved = key, None
        if again and self._library.can_save_state:
            self._saved = self._instance.save_state()

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
            self._instance.discard()
            self._build()

    def _set_start_values(self) -> None:
        self._instance.check("setting the start values", self._start.set())
        for variable, text in self._spec.strings:
            self._instance.set_string(variable, text)

    def _warm_up(self) -> None:
        self._count = 0
        for _ in range(self._spec.warm_up_steps):
            if not _is_fine(self._advance()):
                raise SimulationError(f"the warm-up failed: {self.failure}")

    def step(self) -> int:
        """Set the inputs, step, get the outputs."""
        if self._instance.phase is not _STEPPING:
            return self._failed("a step was asked for before a reset has mended the instance")
        status = self._inputs.set()
        if status and not _is_fine(status):
            return self._failed_call("setting the inputs", status)
        status = self._advance()
        if status and not _is_fine(status) and status != Status.TERMINATED:
            return status
        return self._read_outputs(status)

    def _advance(self) -> int:
        spec, status = self._spec, 0
        for _ in range(spec.substeps):
            time = spec.communication_point(self._count)
            status = self._instance.step(time, self._step_size)
            self._count += 1
            if status and not _is_fine(status):
                doing = f"the step at t = {time:g} s"
                self.failure = self._instance.describe_failure(doing, status)
                break
        return status

    def _read_outputs(self, status: int) -> int:
        """Read into the row; what is not finite is replaced by what was there before."""
        got = self._outputs.get()
        if got and not _is_fine(got):
            return self._failed_call("reading the outputs", got)
        values = self._output_row.tolist()
        total = sum(values)
        if total - total != 0.0 and not all(map(math.isfinite, values)):
            named = zip(self._spec.outputs, values, strict=True)
            bad = ", ".join(f"{v.name} = {value}" for v, value in named if not math.isfinite(value))
            self.failure = f"the outputs are not finite: {bad}"
            self._output_row[:] = self._good_outputs
            return Status.NOT_FINITE
        self._good_outputs = values
        return status

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
        try:
            self._instance.restore_state(snapshot.state)
        except SimulationError as error:
            return self._failed(str(error))
        self._count = snapshot.count
        return self._read_outputs(Status.OK)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """Read any variables now."""
        access = Access(self._instance, variables)
        self._instance.check("reading variables", access.get())
        return access.values
