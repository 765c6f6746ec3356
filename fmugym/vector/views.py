"""The readings of a batch of N environments, and of one environment of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.expressions.quantities import KEPT
from fmugym.pool.base import FloatArray
from fmugym.task.readings import Readings
from fmugym.task.values import EpisodeVariables, ParameterValues

__all__ = ["ColumnReadings", "batched", "some", "take"]


def batched(env: FMUEnv, count: int, outputs: Any = None, inputs: Any = None) -> Readings:
    """Make the readings of a batch: arrays with environments on the last axis, all zero.

    Args:
        env: The prototype.
        count: The number of environments.
        outputs: The array of outputs and monitored variables, by default a new one.
        inputs: The array of inputs, by default a new one.
    """
    space: Any = env.action_space
    shapes: dict[str, tuple[int, ...]] = {
        "outputs": (len(env.out),),
        "states": (env.inside.output_count,),
        "inputs": (len(env.inside.start_inputs),),
        "action": space.shape,
        "number": (),
    }
    arrays = {
        one.attribute: np.zeros(
            (*shapes[one.shape], count), space.dtype if one.shape == "action" else one.dtype
        )
        for one in KEPT
    }
    arrays |= {} if outputs is None else {"outputs": outputs}
    arrays |= {} if inputs is None else {"inputs": inputs}
    variables = EpisodeVariables(env.config.variable_starts)
    variables.update({n: np.zeros((*np.shape(v), count)) for n, v in variables.items()})
    starts = env.inside.draws.variable_starts
    variables.update({n: np.repeat(start, count, axis=-1) for n, start in starts.items()})
    values: Any = arrays["outputs"]
    return Readings(
        env.out.over(lambda: values),
        env.inside.output_count,
        parameters=MappingProxyType({}),
        variables=variables,
        **arrays,
    )


def some(batch: Readings, which: npt.NDArray[np.intp] | slice = slice(None)) -> Readings:
    """Return copies of what the hooks of some environments of a batch read, in the same form.

    Args:
        batch: What the hooks of all read.
        which: Their indices, or a slice.
    """
    return batch.mapped(lambda values: np.array(np.asarray(values)[..., which]))


def take(values: Any, index: int) -> Any:
    """Take one environment's part of an array that has the environments in its last axis."""
    part = np.asarray(values)[..., index]
    return part.item() if part.ndim == 0 and part.dtype.kind == "f" else part[()]


def _column_property(name: str, make: Callable[[npt.NDArray[Any]], Any]) -> Any:
    """A property that makes a value of an environment's part of an array, and writes there."""

    def get(self: ColumnReadings) -> Any:
        return make(getattr(self.batch, name)[..., self.index])

    def put(self: ColumnReadings, value: Any) -> None:
        getattr(self.batch, name)[..., self.index] = value

    return property(get, put)


def _numbers(part: npt.NDArray[Any]) -> tuple[float, ...]:
    return tuple(part.tolist())


_OF_COLUMN: Final[Mapping[str, Callable[[npt.NDArray[Any]], Any]]] = {
    **dict.fromkeys(("outputs", "states", "inputs"), _numbers),
    "action": lambda part: part[()].copy(),
    "number": lambda part: part.item(),
}
"""What makes a value of an environment's part of an array, by the shape of the quantity."""


class ColumnReadings(Readings):
    """The readings of one of N environments: its column of their arrays.

    Values are numbers of Python, made of the arrays when they are read. What is written goes to the
    arrays.

    Args:
        batch: The readings of all.
        index: The environment.
    """

    __slots__ = ("_parameters", "batch", "index")

    def __init__(self, batch: Readings, index: int) -> None:
        self.batch, self.index = batch, index
        self.width = batch.width
        self._parameters: Mapping[str, Any] | None = None  # as they were set
        values = batch.outputs
        self.out = batch.out.over(lambda: _numbers(values[:, index]))

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameters of the episode by name."""
        if self._parameters is not None:
            return self._parameters
        rows = self.batch.parameters.items()
        return MappingProxyType(ParameterValues((n, take(row, self.index)) for n, row in rows))

    @parameters.setter
    def parameters(self, values: Mapping[str, Any]) -> None:
        self._parameters = values
        for name, row in self.batch.parameters.items():
            row[self.index] = values[name]

    @property
    def variables(self) -> EpisodeVariables:  # type: ignore[override]  # written in place
        """The episode variables by name."""
        return _ColumnVariables(self.batch.variables, self.index)

    def begin(
        self,
        inputs: Sequence[float],
        action: Any,
        parameters: Mapping[str, Any],
        variables: Mapping[str, Any],
    ) -> None:
        """See ``Readings.begin``."""
        batch, index = self.batch, self.index
        batch.inputs[:, index], batch.step_count[index] = inputs, 0
        batch.action[..., index] = batch.previous_action[..., index] = action
        batch.done[index] = batch.after_end[index] = False
        self.parameters = parameters
        for name, value in variables.items():
            row = batch.variables[name]
            row[index if row.ndim == 1 else (..., index)] = value

    def look(self, outputs: FloatArray) -> None:
        """See ``Readings.look``; the arrays have the outputs already."""
        self.batch.previous_state[:, self.index] = self.batch.state[:, self.index]


for _quantity in KEPT:
    _property = _column_property(_quantity.attribute, _OF_COLUMN[_quantity.shape])
    setattr(ColumnReadings, _quantity.attribute, _property)
ColumnReadings.state = _column_property("state", _numbers)


class _ColumnVariables(EpisodeVariables):
    """The episode variables of one of N environments; what is written goes to their arrays."""

    def __init__(self, rows: Mapping[str, npt.NDArray[Any]], index: int) -> None:
        dict.__init__(self, {name: take(row, index) for name, row in rows.items()})
        self._rows, self._index = rows, index

    def __setitem__(self, name: str, value: Any) -> None:
        super().__setitem__(name, value)
        self._write()

    def update(self, *args: Any, **kwargs: Any) -> None:
        """See ``EpisodeVariables.update``."""
        super().update(*args, **kwargs)
        self._write()

    def _write(self) -> None:
        for name, value in self.items():
            part = self._rows[name][..., self._index]
            try:
                part[...] = value
            except (TypeError, ValueError):
                raise ConfigError(
                    f"the episode variable {name!r} was set to {shown(value)}, expected "
                    f"{part.size} numbers"
                ) from None
