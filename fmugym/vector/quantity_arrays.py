"""The quantities of N episodes, and of one of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, shown
from fmugym.expressions.quantities import KEPT, PREVIOUS
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.bundle import IndexArray
from fmugym.task.episode import Episode
from fmugym.task.episode_start import EpisodeValues
from fmugym.task.values import EpisodeVariables, ParameterValues

__all__ = ["EpisodeColumn", "batched", "keep_rows", "some", "start_numbers", "take"]


def batched(env: FMUEnv, count: int, pool: Pool | None = None) -> Episode:
    """Make the quantities of N episodes: arrays with environments on the last axis, all zero.

    Args:
        env: The prototype.
        count: The number of environments.
        pool: Has the arrays of some quantities; by default they are new, too.
    """
    space: Any = env.action_space
    shapes: dict[str, tuple[int, ...]] = {
        "outputs": (len(env.out),),
        "states": (env.interface.output_count,),
        "inputs": (len(env.interface.start_inputs),),
        "action": space.shape,
        "number": (),
    }
    arrays = {
        one.attribute: np.zeros(
            (*shapes[one.shape], count), space.dtype if one.shape == "action" else one.dtype
        )
        for one in KEPT
    }
    if pool is not None:
        arrays |= {one.attribute: getattr(pool, one.array) for one in KEPT if one.array}
    variables = EpisodeVariables(env.config.variable_starts)
    variables.update({n: np.zeros((*np.shape(v), count)) for n, v in variables.items()})
    starts = env.episode_start.variable_starts
    variables.update({n: np.repeat(start, count, axis=-1) for n, start in starts.items()})
    values: Any = arrays["outputs"]
    return Episode(
        env.out.over(lambda: values),
        env.interface.output_count,
        parameters=MappingProxyType({}),
        variables=variables,
        **arrays,
    )


def some(batch: Episode, which: npt.NDArray[np.intp] | slice = slice(None)) -> Episode:
    """Copy the quantities of some episodes of a batch, in the same form.

    Args:
        batch: What the hooks of all read.
        which: Their indices, or a slice.
    """
    return batch.mapped(lambda values: np.array(np.asarray(values)[..., which]))


def start_numbers(batch: Episode, which: Any) -> None:
    """Set counts and flags of episodes that begin to zero."""
    for one in KEPT:
        if one.shape == "number":
            getattr(batch, one.attribute)[which] = 0


def keep_rows(batch: Episode, which: Any) -> None:
    """Keep the quantities of some episodes as those before the step."""
    for name, now in PREVIOUS.items():
        getattr(batch, name)[..., which] = getattr(batch, now)[..., which]


def take(values: Any, index: int) -> Any:
    """Take one environment's part of an array that has the environments in its last axis."""
    part = np.asarray(values)[..., index]
    return part.item() if part.ndim == 0 and part.dtype.kind == "f" else part[()]


def _column_property(name: str, make: Callable[[npt.NDArray[Any]], Any]) -> Any:
    """A property that makes a value of an environment's part of an array, and writes there."""

    def get(self: EpisodeColumn) -> Any:
        return make(getattr(self.batch, name)[..., self.index])

    def put(self: EpisodeColumn, value: Any) -> None:
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


class EpisodeColumn(Episode):
    """The quantities of one of N episodes: its column of their arrays.

    Values are numbers of Python, made of the arrays when they are read. What is written goes to the
    arrays.

    Args:
        batch: The quantities of all.
        index: The environment.
    """

    __slots__ = ("_parameters", "batch", "index")

    def __init__(self, batch: Episode, index: int) -> None:
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

    def clear(
        self, indices: IndexArray, inputs: Sequence[float], action: Any, values: EpisodeValues
    ) -> None:
        """See ``Episode.clear``."""
        batch, index = self.batch, self.index
        batch.inputs[:, index] = inputs
        batch.action[..., index] = action
        start_numbers(batch, index)
        self.parameters = values.parameters
        for name, value in values.variables.items():
            row = batch.variables[name]
            row[index if row.ndim == 1 else (..., index)] = value

    def look(self, indices: IndexArray, outputs: FloatArray) -> None:
        """See ``Episode.look``; the arrays have the outputs already."""
        keep_rows(self.batch, self.index)

    def keep(self) -> tuple[Any, ...]:
        """See ``Episode.keep``."""
        before = [getattr(self, name) for name in PREVIOUS], self.action, self.inputs
        keep_rows(self.batch, self.index)
        return before

    def take_back(self, before: tuple[Any, ...]) -> None:
        """See ``Episode.take_back``."""
        values, self.action, self.inputs = before
        for name, value in zip(PREVIOUS, values, strict=True):
            setattr(self, name, value)


for _quantity in KEPT:
    _property = _column_property(_quantity.attribute, _OF_COLUMN[_quantity.shape])
    setattr(EpisodeColumn, _quantity.attribute, _property)
EpisodeColumn.state = _column_property("state", _numbers)


class _ColumnVariables(EpisodeVariables):
    """Episode variables of one of N environments; assignments go to their arrays."""

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
