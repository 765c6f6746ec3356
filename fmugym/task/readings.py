"""Readings of hooks: numbers for one environment, or arrays for N."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.errors import ConfigError
from fmugym.expressions.quantities import KEPT, QUANTITIES
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

KEPT_NAMES: Final = tuple(one.attribute for one in KEPT)


class Readings:
    """The quantities of an episode, which hooks read from their environment; see ``QUANTITIES``.

    In a single environment, each value is a number or a tuple of numbers. In a batch of N
    environments it is an array with the environments on its last axis.

    Args:
        out: The outputs and monitored variables by name.
        width: The number of outputs, which come before the monitored variables.
        values: The quantities by their attributes.

    Attributes:
        out: As given.
        width: As given.
        state: The outputs only.
        outputs: With the monitored variables.
        previous_state, inputs, action, previous_action, step_count, done, after_end, parameters,
            variables: See ``FMUEnv``.
    """

    __slots__ = (*KEPT_NAMES, "out", "parameters", "state", "variables", "width")

    if TYPE_CHECKING:
        out: NamedValues
        width: int
        parameters: Mapping[str, Any]
        variables: EpisodeVariables
        outputs: Any
        state: Any
        previous_state: Any
        inputs: Any
        action: Any
        previous_action: Any
        step_count: Any
        done: Any
        after_end: Any

        def __getattr__(self, name: str) -> Any: ...
        def __setattr__(self, name: str, value: Any) -> None: ...

    def __init__(self, out: NamedValues, width: int, **values: Any) -> None:
        self.out, self.width = out, width
        for name, value in values.items():
            setattr(self, name, value)
        self.state = self.outputs[:width]

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
        self.outputs = tuple(outputs.tolist())
        self.state = self.previous_state = self.outputs[: self.width]

    def copy(self) -> Readings:
        """The same readings in an object of their own; the values are not copied."""
        return self.mapped(lambda value: value)

    def replaced(self, **values: Any) -> Readings:
        """The same readings but for some."""
        result = self.copy()
        for name, value in values.items():
            setattr(result, name, value)
        result.state = result.outputs[: self.width]
        return result

    def mapped(self, each: Callable[[Any], Any]) -> Readings:
        """The same readings with what a function makes of each value."""
        variables = EpisodeVariables(self.variables)
        variables.update({name: each(value) for name, value in self.variables.items()})
        parameters = ParameterValues((n, each(value)) for n, value in self.parameters.items())
        result = Readings(
            self.out,
            self.width,
            parameters=MappingProxyType(parameters),
            variables=variables,
            **{name: each(getattr(self, name)) for name in KEPT_NAMES},
        )
        result.out = self.out.over(lambda: result.outputs)
        return result

    def take_back(self, before: tuple[Any, Any, Any, Any]) -> None:
        """Return to before an action was taken, if the FMU has not stepped.

        Args:
            before: ``action``, ``previous_action``, ``previous_state`` and ``inputs`` of then.
        """
        self.action, self.previous_action, self.previous_state, self.inputs = before


class NoReadings:
    """Stands for what hooks read as long as the constructor of ``FMUEnv`` has not made it."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(_too_early(name), name=name)

    def __setattr__(self, name: str, value: Any) -> None:
        raise ConfigError(f"{_too_early(name)}; give an attribute of your own another name")


def _too_early(name: str) -> str:
    return f"{name!r} is what hooks read, which there is after super().__init__(...) only"


READINGS: Final = (
    *("state", "out"),
    *(one.attribute for one in KEPT if one.name != "outputs"),
    *(one.attribute for one in QUANTITIES.values() if one.shape == "named"),
)
"""The attributes of an environment that hooks read."""


def read_by(name: str) -> Any:
    """Make a property of environments that is one of their readings."""

    def put(env: Any, value: Any) -> None:
        setattr(env.inside.readings, name, value)

    return property(attrgetter(f"inside.readings.{name}"), put)


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
