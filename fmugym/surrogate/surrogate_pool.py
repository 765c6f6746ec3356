"""A pool that a surrogate steps in the place of an FMU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.archive.fmu import FMU
from fmugym.archive.variable import Variable
from fmugym.errors import SimulationError
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.pool.base import FloatArray, MaskArray, Play, PoolSpec, StatusArray
from fmugym.pool.bundle import (
    Bundle,
    IndexArray,
    SaveMethod,
    head_of,
    outputs_of,
    surrogate_state,
)
from fmugym.pool.health import Column, CountedPool, new_arrays
from fmugym.pool.surrounding_programs import play_around
from fmugym.surrogate.start_outputs import Start
from fmugym.surrogate.terms import Terms

__all__ = ["SurrogatePool"]


class SurrogatePool(CountedPool):
    """N instances of a surrogate.

    Args:
        terms: Terms of the changes of outputs.
        start: Outputs at the start of episodes.
        prepare: Makes a function that computes outputs; see ``Surrogate.runs``.
        fmu: Describes the variables; closed with the pool.
        spec: Specification of a reset and step.
        num_instances: N.
    """

    def __init__(
        self,
        terms: Terms,
        start: Start,
        prepare: Callable[[FloatArray, FloatArray], Callable[[], None]],
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
    ) -> None:
        self._use(new_arrays(spec, num_instances))
        self._spec, self._fmu, self._start = spec, fmu, start
        self.step_own = self._step_own
        outputs, inputs = terms.widths
        self._lags, self._outputs = terms.form.lags, outputs
        self._first_input = terms.first_input
        self._first_start = self._first_input + inputs * (1 + terms.form.lags)
        self._rows: FloatArray = np.zeros((len(terms.mean), num_instances))
        self._next: FloatArray = np.zeros((outputs, num_instances))
        self._is_ready = np.zeros(num_instances, np.bool_)
        self._is_first = np.ones(num_instances, np.bool_)
        self._run = prepare(self._rows, self._next)

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        chosen = self._as_mask(mask)
        starts = values[self._places_in(variables)][:, chosen]
        self.outputs[:, chosen] = self._start.outputs(starts)
        self._rows[: self._outputs, chosen] = self.outputs[:, chosen]
        self._rows[self._outputs : self._first_input, chosen] = 0.0
        self._rows[self._first_input : self._first_start, chosen] = 0.0
        self._rows[self._first_start :, chosen] = starts[: len(self._rows) - self._first_start]
        self._is_ready[chosen], self._is_first[chosen] = True, True
        self.statuses[chosen] = Status.OK
        self._counts[chosen, Column.RESETS] += 1
        return self.outputs, self.statuses

    def _places_in(self, variables: tuple[Variable, ...]) -> list[int]:
        """Places of the variables that were set in the courses.

        Raises:
            SimulationError: If others are set, too: nobody knows what they change.
        """
        names, known = [one.name for one in variables], self._start.names
        for name in names:
            if name not in known:
                raise SimulationError(f"{name!r} was not set in the episodes of the surrogate")
        return [names.index(name) for name in known]

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
        observations: npt.NDArray[np.float32] | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        if inputs is not None:
            np.copyto(self.inputs, inputs)
        wanted = self._is_ready if skip is None else self._is_ready & ~skip
        self._take_inputs(wanted)
        self._run()
        self._keep(wanted)
        self._counts[wanted, Column.STEPS] += 1
        if observations is not None:
            np.copyto(observations, self.outputs[: self._spec.num_observed].T, casting="same_kind")
        return self.outputs, self.statuses

    def _take_inputs(self, wanted: MaskArray) -> None:
        """Note the inputs and their changes; nothing has changed before an episode."""
        rows, first, width = self._rows, self._first_input, len(self.inputs)
        if self._lags:
            before = np.where(self._is_first, self.inputs, rows[first : first + width])
            end = self._first_start
            older = rows[first + width : end - width].copy()
            np.copyto(rows[first + 2 * width : end], older, where=wanted)
            np.copyto(rows[first + width : first + 2 * width], self.inputs - before, where=wanted)
        np.copyto(rows[first : first + width], self.inputs, where=wanted)
        self._is_first &= ~wanted

    def _keep(self, wanted: MaskArray) -> None:
        """Take the outputs after the step."""
        rows, count, end = self._rows, self._outputs, self._first_input
        if self._lags:
            older = rows[count : end - count].copy()
            np.copyto(rows[2 * count : end], older, where=wanted)
            np.copyto(rows[count : 2 * count], self._next - rows[:count], where=wanted)
        np.copyto(rows[:count], self._next, where=wanted)
        np.copyto(self.outputs, self._next, where=wanted)

    def _step_own(self) -> int:
        self.step(None, None, self.observations)
        return int(np.count_nonzero(self.statuses > WARNING_CODE))

    def prepare_play(self, variables: tuple[Variable, ...], *parts: Any) -> Play:
        """See ``Pool.prepare_play``."""
        return play_around(self, self._spec, variables, *parts)

    def failure(self, index: int) -> str:
        """See ``Pool.failure``; a surrogate has none."""
        return "a surrogate does not fail"

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``; only the outputs of the last step can be read."""
        names = [one.name for one in self._spec.outputs]
        for one in variables:
            if one.name not in names:
                raise SimulationError(f"{one.name!r} cannot be read from a surrogate")
        return self.outputs[[names.index(one.name) for one in variables]]

    # States.

    @property
    def save_method(self) -> SaveMethod:
        """See ``Pool.save_method``."""
        return SaveMethod.STATE

    def save_instances(self, indices: IndexArray) -> Bundle:
        """See ``Pool.save_instances``."""
        flags = np.array([self._is_ready, self._is_first], np.float64)
        contents = np.concatenate([self._rows, flags])[:, indices].T
        outputs = self.outputs[:, indices].T
        pairs = zip(outputs, contents, strict=True)
        return Bundle(tuple(surrogate_state(one, row.tobytes()) for one, row in pairs))

    def restore_instances(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> StatusArray:
        """See ``Pool.restore_instances``."""
        states = bundle.states_at(sources)
        if not all(head_of(state).is_of_surrogate for state in states):
            raise SimulationError("the snapshot is of the FMU, not of its surrogate")
        parts = [outputs_of(state, self._outputs) for state in states]
        rows = [np.frombuffer(content) for _, content in parts]
        if any(len(row) != len(self._rows) + 2 for row in rows):  # with two flags
            raise SimulationError("the snapshot is of another surrogate")
        for (outputs, _), (*row, ready, first), index in zip(parts, rows, indices, strict=True):
            self.outputs[:, index], self._rows[:, index] = outputs, row
            self._is_ready[index], self._is_first[index] = bool(ready), bool(first)
            self.statuses[index] = Status.OK
        return self.statuses

    def close(self) -> None:
        """See ``Pool.close``."""
        self._fmu.close()
