"""What hooks read: numbers for one environment, or arrays for N."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError
from fmugym.pool.base import FloatArray
from fmugym.task.values import EpisodeVariables, NamedValues, ParameterValues

__all__ = [
    "READINGS",
    "NoReadings",
    "Readings",
    "environments_first",
    "environments_last",
    "read_by",
    "reading",
]


@dataclass(slots=True)
class Readings:
    """The values that hooks read from their environment.

    In a single environment, each value is a number or a tuple of numbers. In a batch of N
    environments it is an array with the environments on its last axis.

    Attributes:
        values: The outputs and the monitored variables.
        out: The same values by name.
        state: The outputs only.
        previous_state, inputs, action, previous_action, step_count, done, after_end, parameters,
            variables: See ``FMUEnv``.
    """

    values: Any
    out: NamedValues
    state: Any
    previous_state: Any
    inputs: Any
    action: Any
    previous_action: Any
    step_count: Any
    done: Any
    after_end: Any
    parameters: Mapping[str, Any]
    variables: EpisodeVariables

    def begin(
        self,
        inputs: Sequence[float],
        action: Any,
        parameters: Mapping[str, Any],
        variables: Mapping[str, Any],
    ) -> None:
        """Begin the episode of a single environment; its outputs follow with ``look``.

        Args:
            inputs: The inputs before the first step.
            action: What stands for the action of a step.
            parameters: By name.
            variables: By name.
        """
        self.inputs, self.parameters, self.step_count = tuple(inputs), parameters, 0
        self.action = self.previous_action = action
        self.done = self.after_end = False
        dict.update(self.variables, variables)

    def look(self, outputs: FloatArray) -> None:
        """Take the outputs and monitored variables of a single environment that has not stepped."""
        self.values = tuple(outputs.tolist())
        self.state = self.previous_state = self.values[: len(self.state)]

    def copy(self) -> Readings:
        """The same readings in an object of their own; the values are not copied."""
        return replace(self)

    def mapped(self, each: Callable[[Any], Any]) -> Readings:
        """The same readings with what a function makes of each value."""
        variables = EpisodeVariables(self.variables)
        variables.update({name: each(value) for name, value in self.variables.items()})
        parameters = ParameterValues((n, each(value)) for n, value in self.parameters.items())
        result = replace(
            self.copy(),
            values=each(self.values),
            parameters=MappingProxyType(parameters),
            variables=variables,
            **{name: each(getattr(self, name)) for name in _ROWS},
        )
        result.state = result.values[: len(self.state)]
        result.out = self.out.over(lambda: result.values)
        return result

    def take_back(self, before: tuple[Any, Any, Any, Any]) -> None:
        """Return to before an action was taken, if the FMU has not stepped.

        Args:
            before: ``action``, ``previous_action``, ``previous_state`` and ``inputs`` of then.
        """
        self.action, self.previous_action, self.previous_state, self.inputs = before


_ROWS: Final = (
    *("previous_state", "inputs", "action", "previous_action", "step_count", "done", "after_end"),
)
"""Those that are neither mappings nor outputs."""


class NoReadings:
    """Stands for what hooks read as long as the constructor of ``FMUEnv`` has not made it."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(_too_early(name), name=name)

    def __setattr__(self, name: str, value: Any) -> None:
        raise ConfigError(f"{_too_early(name)}; give an attribute of your own another name")


def _too_early(name: str) -> str:
    return f"{name!r} is what hooks read, which there is after super().__init__(...) only"


READINGS: Final = tuple(field.name for field in fields(Readings) if field.name != "values")
"""The attributes of an environment that hooks read."""


def read_by(name: str, get: Callable[[Any], Any]) -> Any:
    """Make a property of environments that is one of their readings.

    Args:
        name: That of the reading.
        get: Reads it; a function that does nothing else is the fastest way.
    """

    def put(env: Any, value: Any) -> None:
        setattr(env.inside.readings, name, value)

    return property(get, put)


def environments_first(values: Any) -> Any:
    """View an array with its last axis first."""
    if type(values) is np.ndarray and values.ndim <= 2:
        return values.T  # moveaxis takes ten times as long
    return np.moveaxis(values, -1, 0)


def environments_last(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """View an array with its first axis last."""
    return values.T if values.ndim <= 2 else np.moveaxis(values, 0, -1)


@contextmanager
def reading(env: Any, readings: Readings) -> Iterator[None]:
    """Let the hooks of an environment read other values inside of a ``with`` block.

    The environment stays the same object. So objects and functions that it holds, and that refer
    to it, read the same values as its hooks.
    """
    with env.inside.standing_in:
        before, env.inside.readings = env.inside.readings, readings
        try:
            yield
        finally:
            env.inside.readings = before
