"""The symbols that hooks read while they are traced."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.task.readings import Readings
from fmugym.task.values import EpisodeVariables, NamedTexts, NamedValues, ParameterValues
from fmugym.vector.hooks.graph import Graph
from fmugym.vector.hooks.program import UntraceableError
from fmugym.vector.hooks.symbols import LANES, Symbols, lift, loaded

__all__ = ["SymbolicParameters", "element_names", "symbolic_outputs", "symbolic_readings"]


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

    def rows(shape: tuple[int, ...], *head: Any, dtype: Any = np.float64) -> Any:
        return loaded(graph, "row", element_names(shape, *head), dtype)

    values = rows((len(env.out),), "output")
    state = values[: env.inside.output_count]
    names = EpisodeVariables(env.config.episode_variables)
    for name, dtype in variables.items():
        shape = np.shape(env.config.episode_variables[name])
        names[name] = rows(shape, "before" if judging else "variable", name, dtype=dtype)
    missing = np.array("it reads self.done before there is one", object)
    known = dict.fromkeys((*env.inside.interface.parameters, *env.parameters))
    return Readings(
        values=values,
        out=symbolic_outputs(env, values),
        state=state,
        previous_state=rows((len(env.out),), "kept")[: env.inside.output_count]
        if judging
        else state,
        inputs=rows((len(env.inside.interface.inputs),), "input"),
        action=_symbolic_action(env, graph, "action"),
        previous_action=_symbolic_action(env, graph, "previous_action"),
        step_count=rows((), "step_count", dtype=np.int64),
        done=loaded(graph, "missing", missing, np.bool_),
        after_end=lift(graph, np.zeros(LANES, np.bool_)),
        parameters=MappingProxyType(
            SymbolicParameters(
                {n: rows((), "parameter", n) for n in known},
                env.fmu.description.strings,
            )
        ),
        variables=names,
    )


def symbolic_outputs(env: FMUEnv, values: Any) -> NamedValues:
    """Symbols by the names of outputs; Strings have none."""
    strings = env.fmu.description.strings.intersection(env.out)
    return _SymbolicOutputs(list(env.out), strings, lambda: values)


class _SymbolicOutputs(NamedTexts):
    """The symbols of outputs; hooks that read a String cannot be traced."""

    def _shown(self, name: str, value: Any) -> Any:
        raise UntraceableError(f"it reads the String {name!r}")


class SymbolicParameters(ParameterValues):
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


def _symbolic_action(env: FMUEnv, graph: Graph, kind: str) -> Symbols:
    space: Any = env.action_space
    names = np.empty(space.shape or (), object)
    for index, place in enumerate(np.ndindex(names.shape)):
        names[place] = index
    return loaded(graph, kind, names, space.dtype)


def element_names(shape: tuple[int, ...], *head: Any) -> npt.NDArray[Any]:
    """The rows of an array: a name for each element."""
    names = np.empty(shape, object)
    for index, place in enumerate(np.ndindex(shape)):
        names[place] = (*head, index)
    return names
