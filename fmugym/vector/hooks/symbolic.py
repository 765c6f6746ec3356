"""The symbols that hooks read while they are traced."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from fmugym.env import FMUEnv
from fmugym.expressions.graph import Graph
from fmugym.expressions.program import UntraceableError
from fmugym.task.readings import Readings
from fmugym.task.values import NamedValues, ParameterValues
from fmugym.vector.hooks.symbols import LANES, lift, loaded, loaded_rows
from fmugym.vector.views import batched

__all__ = ["symbolic_readings"]


def symbolic_readings(
    env: FMUEnv, graph: Graph, variables: Mapping[str, np.dtype[Any]], judging: bool
) -> Readings:
    """Make readings in which symbols stand for what programs load.

    Args:
        env: The prototype.
        graph: Records the operations.
        variables: The types of the episode variables.
        judging: Whether the FMU has stepped.
    """
    rows: Callable[..., Any] = partial(loaded_rows, graph)
    values, strings = rows((len(env.out),), "output"), env.fmu.description.strings
    read = batched(env, LANES, values, rows((len(env.inside.interface.inputs),), "input"))
    read.out = NamedValues("output", list(env.out), lambda: values)
    kept = rows((len(env.out),), "kept") if judging else values
    read.previous_state = kept[: env.inside.output_count]
    space: Any = env.action_space
    for name in ("action", "previous_action"):
        symbols = loaded(graph, name, space.shape or (), lambda index: index, space.dtype)
        setattr(read, name, symbols)
    read.step_count = rows((), "step_count", dtype=np.int64)
    missing = "it reads self.done before there is one"
    read.done = loaded(graph, "missing", (), lambda _: missing, np.bool_)
    read.after_end = lift(graph, read.after_end)
    known = dict.fromkeys((*env.inside.interface.parameters, *env.parameters))
    parameters = {name: rows((), "parameter", name) for name in known}
    read.parameters = MappingProxyType(_SymbolicParameters(parameters, strings))
    for name, dtype in variables.items():
        shape = np.shape(env.config.variable_starts[name])
        head = "before" if judging else "variable", name
        read.variables[name] = rows(shape, *head, dtype=dtype)
    return read


class _SymbolicParameters(ParameterValues):
    """The symbols of parameters; Strings have none, and hooks that read one cannot be traced.

    Args:
        symbols: The symbols by name; those of Strings are not used.
        strings: The names of the Strings.
    """

    def __init__(self, symbols: Mapping[str, Any], strings: frozenset[str]) -> None:
        super().__init__(symbols)
        self._strings = strings

    def __getitem__(self, name: str) -> Any:
        self._require_number(name)
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        """Do what ``dict.get`` does."""
        self._require_number(name)
        return super().get(name, default)

    def _require_number(self, name: Any) -> None:
        if name in self._strings:
            raise UntraceableError(f"it reads the String {name!r}")
