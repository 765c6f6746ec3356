"""Surrogate: the outputs of the next step, as a program of expressions.

It steps a pool in the place of an FMU.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.control.surrogate.terms import Start, Terms, rows_in
from fmugym.errors import SimulationError
from fmugym.expressions.compiler import Store, compile_graph
from fmugym.expressions.graph import Graph, Value
from fmugym.expressions.program import Program, engine
from fmugym.fmi.fmu import FMU
from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.fmi.variable import Variable
from fmugym.pool.health import Column, CountedPool, new_arrays
from fmugym.pool.native_pool import play_around
from fmugym.pool.opening import PoolOptions
from fmugym.pool.pool import FloatArray, MaskArray, Play, PoolSpec, StatusArray
from fmugym.pool.states import Bundle, IndexArray, SaveMethod, head_of, outputs_of, surrogate_state

__all__ = ["Surrogate", "SurrogatePool"]


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
        """Places of the variables that were set in the trajectories.

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
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        if inputs is not None:
            np.copyto(self.inputs, inputs)
        wanted = self._is_ready if skip is None else self._is_ready & ~skip
        self._take_inputs(wanted)
        self._run()
        self._keep(wanted)
        self._counts[wanted, Column.STEPS] += 1
        observed = self.outputs[: self._spec.num_observed].T
        np.copyto(self.observations, observed, casting="same_kind")
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
        self.step()
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


@dataclass(frozen=True)
class Surrogate:
    """Model of a step of an FMU, fitted to its trajectories.

    Given as the ``backend`` of environments, it steps in the place of the FMU.

    Attributes:
        terms: Terms of the changes of outputs.
        weights: Weights of the terms, shape (k, f).
        low, high: The range in which outputs stay, shape (k,).
        start: The outputs with which episodes begin.
        error: Error of simulations which the fit has not seen, beside the spread of the outputs.
        spec: Specification of a step.
        variables: P variables that are set before initialization.
    """

    terms: Terms
    weights: FloatArray
    low: FloatArray
    high: FloatArray
    start: Start
    error: float
    spec: PoolSpec
    variables: tuple[Variable, ...]

    def open_pool(
        self,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        log: logging.Logger,
        options: PoolOptions,
    ) -> SurrogatePool:
        """Open a pool that the surrogate steps; see ``fmugym.pool.opening.open_pool``."""
        pool = SurrogatePool(self.terms, self.start, self.runs, fmu, spec, num_instances)
        pool.execution = (f"{fmu.path.name}: a surrogate steps in its place",)
        return pool

    def programs(self) -> tuple[list[Program], list[float]]:
        """The programs of a step, of the factors and of each output, and their numbers.

        They read what a step depends on from the rows ``("x", i)``, and numbers from rows, as there
        are more of them than a program may have constants. They write ``("next", i)``.
        """
        numbers: list[float] = []
        graph = Graph()
        factors = self.terms.factors(
            rows_in(graph, "x", len(self.terms.mean)), _rows_of_numbers(graph, numbers)
        )
        stores = [Store(one.node, ("factor", i)) for i, one in enumerate(factors)]
        found = [compile_graph(graph, stores)]
        for place, weights in enumerate(self.weights.tolist()):
            graph = Graph()
            now = Value.read(graph, "x", place, dtype=np.float64)
            seen = rows_in(graph, "factor", len(factors))
            total = self._next(place, now, seen, [*map(_rows_of_numbers(graph, numbers), weights)])
            found.append(compile_graph(graph, [Store(total.node, ("next", place))]))
        return found, numbers

    def _next(
        self, place: int, now: Value, factors: Sequence[Value], weights: Sequence[Any]
    ) -> Value:
        """An output after the step."""
        total: Any = now + self.terms.total(factors, weights)
        low, high = float(self.low[place]), float(self.high[place])
        found: Value = np.minimum(np.maximum(total, low), high) if np.isfinite(low) else total
        return found

    def runs(self, rows: FloatArray, after: FloatArray) -> Callable[[], None]:
        """Make a function from regressors of a step to the outputs after it.

        Args:
            rows: Shape (d, N).
            after: Shape (k, N).
        """
        count = rows.shape[1]
        programs, numbers = self.programs()
        factors: FloatArray = np.zeros((self.terms.factor_count, count))
        repeated = np.repeat(np.reshape(numbers, (-1, 1)), count, axis=1)
        arrays: dict[str, Any] = {"x": rows, "factor": factors, "number": repeated, "next": after}

        def find(row: Any) -> FloatArray:
            name, place = row
            found: FloatArray = arrays[name][place]
            return found

        parts = [one.with_rows(find) for one in programs]

        def run() -> None:
            for one in parts:
                engine().evaluate(one, count)

        return run

    def next_outputs(self, row: Sequence[Value]) -> list[Value]:
        """Outputs after the step, from its regressors."""
        factors = self.terms.factors(row)
        return [
            self._next(place, row[place], factors, weights)
            for place, weights in enumerate(self.weights.tolist())
        ]


def _rows_of_numbers(graph: Graph, numbers: list[float]) -> Callable[[float], Value]:
    """A function that adds a number, and returns the row which it stands in."""

    def row(number: float) -> Value:
        numbers.append(number)
        return Value.read(graph, "number", len(numbers) - 1, dtype=np.float64)

    return row
