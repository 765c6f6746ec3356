"""The pool in Python: FMPy's functions with buffers made beforehand, one instance after another."""

from __future__ import annotations

import ctypes
import logging

import numpy as np
import numpy.typing as npt

from fmugym.adapters import Access, Library, Phase, Status
from fmugym.archive import FMU
from fmugym.errors import SimulationError
from fmugym.model_description import Variable
from fmugym.pool.base import PoolSpec

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
        # One row an instance, so that the FMU reads and writes this memory without a copy.
        input_rows = np.zeros((num_instances, len(spec.inputs)))
        output_rows = np.zeros((num_instances, len(spec.outputs)))
        self._inputs, self._outputs = input_rows.T, output_rows.T
        self._status = np.zeros(num_instances, np.int8)
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
        self,
        variables: tuple[Variable, ...],
        values: npt.NDArray[np.float64],
        mask: npt.NDArray[np.bool_] | None = None,
    ) -> npt.NDArray[np.float64]:
        """See ``Pool.reset``."""
        for index, slot in enumerate(self._slots):
            if mask is None or mask[index]:
                slot.reset(variables, values[:, index])
                self._status[index] = Status.OK
        return self._outputs

    def step(
        self, inputs: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int8]]:
        """See ``Pool.step``."""
        np.copyto(self._inputs, inputs)
        for index, slot in enumerate(self._slots):
            self._status[index] = slot.step()
        return self._outputs, self._status

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        return self._slots[index].describe_failure(int(self._status[index]))

    def read(self, variables: tuple[Variable, ...]) -> npt.NDArray[np.float64]:
        """See ``Pool.read``."""
        return np.stack([slot.read(variables) for slot in self._slots], axis=1)

    def close(self) -> None:
        """See ``Pool.close``."""
        self._library.close()


_OUTPUTS_ARE_LOST = frozenset({int(Status.ERROR), int(Status.FATAL)})


def _is_bad(status: int) -> bool:
    return status > Status.WARNING or status < 0


class _Slot:
    """One place of the pool: its instance, which is replaced when it is past mending."""

    def __init__(
        self,
        library: Library,
        spec: PoolSpec,
        input_row: npt.NDArray[np.float64],
        output_row: npt.NDArray[np.float64],
    ) -> None:
        self._library = library
        self._spec = spec
        self._rows = input_row, output_row
        self._step_size = spec.communication_step_size
        self._doing = ""
        self._build()

    def _build(self) -> None:
        spec, (input_row, output_row) = self._spec, self._rows
        self._instance = self._library.instantiate()
        self._inputs = Access(self._instance, spec.inputs, input_row)
        self._outputs = Access(self._instance, spec.outputs, output_row)
        self._start_variables: tuple[Variable, ...] = ()
        self._start = Access(self._instance, ())
        self._start_key: tuple[tuple[Variable, ...], bytes] | None = None
        self._saved: ctypes.c_void_p | None = None
        self._count = 0

    def reset(self, variables: tuple[Variable, ...], values: npt.NDArray[np.float64]) -> None:
        """Start anew by the cheapest way that gives the same as a fresh instance.

        The state after initialization is kept once the same start values come a second time, and
        restored from then on; other start values take a reset and an initialization.
        """
        key = (variables, values.tobytes())
        if not self._restored(key):
            self._initialize(variables, values)
            self._keep_state(key)
        self._count = self._spec.warm_up_steps * self._spec.substeps
        self._instance.check("reading the outputs", self._outputs.get())

    def _restored(self, key: tuple[tuple[Variable, ...], bytes]) -> bool:
        if self._saved is None or key != self._start_key or self._instance.phase is Phase.DEAD:
            return False
        self._instance.restore_state(self._saved)
        return True

    def _keep_state(self, key: tuple[tuple[Variable, ...], bytes]) -> None:
        if self._saved is not None:
            self._instance.free_state(self._saved)
            self._saved = None
        if self._library.can_save_state and key == self._start_key:
            self._saved = self._instance.save_state()
        self._start_key = key

    def _initialize(self, variables: tuple[Variable, ...], values: npt.NDArray[np.float64]) -> None:
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
            self._instance.check("the warm-up", self._advance())

    def step(self) -> int:
        """Set the inputs, step, get the outputs; returns the worst status."""
        status = self._inputs.set()
        if status != 0 and _is_bad(status):
            return self._failed("setting the inputs", status)
        status = self._advance()
        if status in _OUTPUTS_ARE_LOST:
            return status
        got = self._outputs.get()
        if got != 0 and _is_bad(got):
            return self._failed("reading the outputs", got)
        return status

    def _advance(self) -> int:
        status = 0
        for _ in range(self._spec.substeps):
            time = self._spec.communication_point(self._count)
            status = self._instance.step(time, self._step_size)
            self._count += 1
            if status > Status.WARNING:
                self._doing = f"the step at t = {time:g} s"
                break
        return status

    def _failed(self, doing: str, status: int) -> int:
        self._doing = doing
        return self._instance.judge(status)

    def describe_failure(self, status: int) -> str:
        """Say what the last bad status came from."""
        return self._instance.describe_failure(self._doing, status)

    def read(self, variables: tuple[Variable, ...]) -> npt.NDArray[np.float64]:
        """Read any variables now."""
        access = Access(self._instance, variables)
        self._instance.check("reading variables", access.get())
        return access.values
