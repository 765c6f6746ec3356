"""A surrogate: the outputs of the next step, as a program of expressions."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmugym.archive.fmu import FMU
from fmugym.archive.variable import Variable
from fmugym.expressions.graph import Graph
from fmugym.expressions.lowering import Store, compile_graph
from fmugym.expressions.program import Program, engine
from fmugym.expressions.value import Value
from fmugym.pool.base import FloatArray, PoolSpec
from fmugym.surrogate.start_outputs import Start
from fmugym.surrogate.surrogate_pool import SurrogatePool
from fmugym.surrogate.terms import Terms, rows_in
from fmugym.trial.pool_options import PoolOptions

__all__ = ["Surrogate"]


@dataclass(frozen=True)
class Surrogate:
    """Model of a step of an FMU, fitted to its courses.

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
        """Open a pool that the surrogate steps; see ``fmugym.trial.opening.open_pool``."""
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
