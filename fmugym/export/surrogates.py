"""Surrogates as exported agents, from inputs and kept values to outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from fmugym.archive.description import Unit
from fmugym.export.exportable import ExportedAgent, check_name
from fmugym.export.logic import Kept, Logic, Parameter
from fmugym.expressions.graph import Graph
from fmugym.expressions.value import Value, where
from fmugym.pool.spec import is_start_time
from fmugym.surrogate.surrogate import Surrogate

__all__ = ["agent_of_surrogate"]

_DOUBLE: Final = np.dtype(np.float64)


def agent_of_surrogate(surrogate: Surrogate, name: str, units: Mapping[str, Unit]) -> ExportedAgent:
    """A surrogate in the form of an agent: the FMU's inputs are measurements, its outputs actions.

    The first sample gives the outputs at the start, and each other one those after a step. What
    was set before initialization in its courses are parameters.

    Args:
        surrogate: The surrogate.
        name: Name of functions and files: letters, digits and _.
        units: Units of the FMU by name.

    Raises:
        ConfigError: If the name cannot be that of a file and a function of C.
    """
    logic = _Writer(surrogate).logic()
    note = f"Surrogate: {surrogate.terms.form}; fitted to simulations of an FMU."
    return ExportedAgent(check_name(name), logic, None, (note,), units, is_plant=True)


class _Writer:
    """Makes the graph of a surrogate."""

    def __init__(self, surrogate: Surrogate) -> None:
        self._surrogate, self._graph = surrogate, Graph()
        self._loads: dict[int, Any] = {}
        self._kept: list[Kept] = []

    def logic(self) -> Logic:
        """Make the logic from inputs and kept values to outputs."""
        surrogate, spec = self._surrogate, self._surrogate.spec
        outputs, lags = len(spec.outputs), surrogate.terms.form.lags
        given = [self._loaded("measurement", place) for place in range(len(spec.inputs))]
        starts = [float(mean) for mean in surrogate.start.mean]
        parameters = self._keeping("starts", starts)
        before = self._keeping("outputs", [0.0] * outputs * (1 + lags))
        inputs, updates = self._inputs(given)
        row = [*before, *inputs, *(parameters if surrogate.terms.form.starts else ())]
        is_later = self._loaded("active", dtype=np.dtype(np.bool_))
        first = surrogate.start.values(parameters) if parameters else self._constants()
        pairs = zip(surrogate.next_outputs(row), first, strict=True)
        after = [where(is_later, one, other) for one, other in pairs]
        changes = [
            where(is_later, one - other, 0.0) for one, other in zip(after, before, strict=False)
        ]
        self._update("outputs", [*after, *changes, *before[outputs:]][: len(before)])
        self._update("inputs", updates)
        return Logic(
            self._graph,
            self._loads,
            spec.inputs,
            spec.outputs,
            tuple(one.node for one in after),
            (),
            tuple(self._kept),
            tuple(self._parameters()),
            spec.time_step,
        )

    def _inputs(self, given: Sequence[Value]) -> tuple[list[Value], list[Value]]:
        """Part of a row for inputs and their changes, and the values that are kept for it."""
        lags = self._surrogate.terms.form.lags
        kept = self._keeping("inputs", [0.0] * len(given) * lags)
        count = self._loaded("count", dtype=np.dtype(np.int64))
        changes = [
            where(count > 1, one - other, 0.0) for one, other in zip(given, kept, strict=False)
        ]
        row = [*given, *changes, *kept[len(given) :]]
        return row, row[: len(kept)]

    def _constants(self) -> list[Value]:
        """Outputs at the start of all episodes, if no start values are set."""
        return [Value.of(self._graph, float(one)) for one in self._surrogate.start.weights[:, 0]]

    def _loaded(self, *load: Any, dtype: np.dtype[Any] = _DOUBLE) -> Value:
        value = Value.read(self._graph, *map(str, load), dtype=dtype)
        self._loads[value.node] = load
        return value

    def _keeping(self, name: str, starts: Sequence[float]) -> list[Value]:
        """Keep numbers that begin so; nothing if there are none."""
        if not starts:
            return []
        self._kept.append(Kept(name, _DOUBLE, tuple(starts), ()))
        field = len(self._kept) - 1
        return [self._loaded("kept", field, place) for place in range(len(starts))]

    def _update(self, name: str, values: Sequence[Value]) -> None:
        """Let kept numbers become these."""
        nodes = tuple(one.node for one in values)
        self._kept = [
            replace(one, updates=nodes) if one.name == name else one for one in self._kept
        ]

    def _parameters(self) -> list[Parameter]:
        variables = enumerate(self._surrogate.variables)
        means = self._surrogate.start.mean
        return [
            Parameter(one.name, 0, place, float(means[place]), one)
            for place, one in variables
            if not is_start_time(one)
        ]
