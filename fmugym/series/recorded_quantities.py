"""Recorded quantities: the values of environments that a recorder reads and writes down."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from gymnasium import spaces

from fmugym.archive.variable import Variable
from fmugym.checks import normal_form
from fmugym.env import FMUEnv
from fmugym.errors import unknown_name
from fmugym.pool.base import FloatArray, Pool
from fmugym.task.quantity import Quantities, Quantity
from fmugym.task.variable_roles import require_numeric

__all__ = ["RecordedEnvs", "RecordedQuantities", "choose", "matches", "quantities_of"]

_VARYING: Final = ("continuous", "discrete")


class RecordedEnvs(Protocol):
    """Interface of N environments that a recorder reads.

    Attributes:
        prototype: One of them.
        count: N.
        is_vector: Whether they are those of a vector environment.
    """

    prototype: FMUEnv
    count: int
    is_vector: bool

    def evaluate(self, function: Callable[[Any], Sequence[Any]], indices: Any) -> FloatArray:
        """Evaluate a function of M of the environments; shape (k, M)."""

    @property
    def pool(self) -> Pool:
        """Reads variables of the FMUs."""


class RecordedQuantities(NamedTuple):
    """Quantities that a recorder writes down.

    Attributes:
        quantities: All of them, in the order of the columns.
        places: Which of the task's quantities are the first ones.
        read: Reads all of the task's quantities of an environment.
        variables: Variables of the FMU that come next.
        observed: The elements of the observation that come last.
    """

    quantities: tuple[Quantity, ...]
    places: tuple[int, ...]
    read: Callable[[Any], Sequence[Any]]
    variables: tuple[Variable, ...]
    observed: tuple[int, ...]

    def present(self, episodes: RecordedEnvs, indices: Any) -> FloatArray:
        """Present values of M environments, without the observations.

        Args:
            episodes: All environments.
            indices: The M environments.

        Returns:
            One row for each environment, one column for each quantity.
        """
        rows = [episodes.evaluate(self.read, indices)[list(self.places)]]
        if self.variables:
            rows.append(episodes.pool.read(self.variables)[:, indices])
        return np.concatenate(rows).T

    def seen(self, observations: Any, indices: Any) -> FloatArray:
        """Observations of M environments; no values if observations are no arrays.

        Args:
            observations: Observations of all environments.
            indices: The M environments.

        Returns:
            One row for each environment, one column for each element.
        """
        if not isinstance(observations, np.ndarray):
            return np.empty((len(indices), 0))
        rows = observations[indices].reshape(len(indices), -1)
        chosen: FloatArray = rows[:, list(self.observed)].astype(np.float64)
        return chosen


def matches(pattern: str, name: str) -> bool:
    """Whether a name matches a glob: * is any text, ? one character, brackets are themselves."""
    pattern, name = normal_form(pattern), normal_form(name)
    expression = re.escape(pattern).replace(r"\*", ".*").replace(r"\?", ".")
    return re.fullmatch(expression, name, re.DOTALL) is not None


def choose(env: FMUEnv, patterns: Iterable[str] | None) -> RecordedQuantities:
    """Find the values that globs name.

    Args:
        env: The environment, or the prototype of many.
        patterns: Globs. They choose among the names of the task, the varying variables of the FMU
            that the task has no name for, and ``observation.NAME``, what the agent sees of a name.
            None for all names of the task except parameters.

    Raises:
        ConfigError: If a glob matches nothing.
    """
    quantities, read = quantities_of(env)
    others = {variable.name: variable for variable in _others(env, quantities)}
    seen = {f"observation.{name}": index for index, name in enumerate(_observation_names(env))}
    if patterns is None:
        wanted = {one.name for one in quantities if one.kind != "parameter"}
    else:
        named = [one.name for one in quantities] + [n for n in others if _varies(others[n])]
        known = [*named, *seen]
        for pattern in patterns:
            _require_numbers(env, pattern)
        wanted = {name for one in patterns for name in _found(one, known, others)}
    places = tuple(i for i, one in enumerate(quantities) if one.name in wanted)
    variables = tuple(others[name] for name in others if name in wanted)
    observed = tuple(index for name, index in seen.items() if name in wanted)
    return RecordedQuantities(
        (
            *(quantities[place] for place in places),
            *map(_of_variable, variables),
            *(Quantity(name, "observation") for name in seen if name in wanted),
        ),
        places,
        read,
        variables,
        observed,
    )


def _require_numbers(env: FMUEnv, name: str) -> None:
    """Refuse a variable of the FMU that can never be read."""
    variable = env.fmu.description.variables.get(name)
    if variable is not None and not variable.is_number and not variable.ticking:
        require_numeric(variable, "recorded")


def _found(pattern: str, known: Sequence[str], others: Iterable[str]) -> list[str]:
    """The names that a glob finds; constants and parameters must be named in full.

    The name of an array stands for its elements.
    """
    own = normal_form(pattern)
    arrays = {name: _array_of(normal_form(name)) for name in (*known, *others)}
    found = [name for name in known if matches(pattern, name) or arrays[name] == own]
    found += [n for n in others if own in {normal_form(n), arrays[n]} and n not in found]
    if not found:
        raise unknown_name("variable to record", pattern, [*known, *others])
    return found


def _array_of(name: str) -> str:
    """The name of the array of which this is an element; "" if it is none."""
    return name.rpartition("[")[0] if name.endswith("]") else ""


def _varies(variable: Variable) -> bool:
    return variable.variability in _VARYING and variable.causality != "independent"


def quantities_of(env: FMUEnv) -> Quantities:
    """Quantities of a task, or of the config if there is no task."""
    of_task = None if env.resolved is None else env.resolved.quantities
    return _of_config(env) if of_task is None else of_task()


def _of_config(env: FMUEnv) -> Quantities:
    interface, strings = env.interface, env.fmu.description.strings
    inputs, outputs = interface.inputs, (*interface.outputs, *interface.monitors)
    episode = [n for n, value in env.config.variable_starts.items() if np.ndim(value) == 0]
    parameters = tuple(name for name in interface.parameters if name not in strings)

    def read(env: Any) -> Sequence[Any]:
        drawn, variables = env.parameters, env.variables
        return (
            *(env.inputs[index] for index in range(len(inputs))),
            *env.out.values(),
            *(variables[name] for name in episode),
            *(drawn.get(name, np.nan) for name in parameters),
        )

    found = [_of_variable(variable, "action") for variable in inputs]
    found += [_of_variable(variable) for variable in outputs]
    found += [Quantity(name, "memory") for name in episode]
    for name in parameters:
        variable = interface.parameter(name, interface.parameters[name])
        found.append(replace(_of_variable(variable, "parameter"), name=name))
    return Quantities(found, read)


def _of_variable(variable: Variable, kind: str = "output") -> Quantity:
    return Quantity(variable.name, kind, variable.unit or "", *variable.range)


def _others(env: FMUEnv, quantities: Sequence[Quantity]) -> Iterator[Variable]:
    """Numbers of the FMU for which the task has no name of its own."""
    known = {*env.interface.input_names, *env.out, *(one.name for one in quantities)}
    for variable in env.fmu.description.variables.values():
        if variable.is_number:
            yield from (one for one in variable.elements if one.name not in known)


def _observation_names(env: FMUEnv) -> Sequence[str]:
    space = env.observation_space
    if env.observation_names is not None:
        return env.observation_names
    if isinstance(space, spaces.Box):
        return [str(index) for index in range(int(np.prod(space.shape)))]
    return []
