"""Arrays of the quantities of N episodes, and the quantities of one of them.

Compiled steps, and hooks on arrays, read and write the arrays in place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import Episode
from fmugym.environment.episode_start import EpisodeValues
from fmugym.environment.value_mappings import EpisodeVariables, ParameterValues
from fmugym.environment.vector import array_results
from fmugym.errors import ConfigError, shown
from fmugym.expressions.program import Row
from fmugym.expressions.quantities import KEPT, PREVIOUS
from fmugym.pool.pool import FloatArray, MaskArray, Pool
from fmugym.pool.states import IndexArray

__all__ = [
    "EpisodeArrays",
    "EpisodeColumn",
    "batched",
    "element_row",
    "keep_rows",
    "some",
    "start_numbers",
    "take",
]


class EpisodeArrays:
    """Arrays of N episodes, which steps read and write in place.

    Args:
        env: An environment, for what all have in common.
        quantities: The quantities that hooks read; arrays of this object become theirs.
        ended: Which episodes have ended, shape (N,).

    Attributes:
        quantities, ended: As given.
        parameters: The rows of the parameters by name; to be set before steps.
        given: The inputs that hooks on arrays have made, shape (m, N).
        kept: The outputs before the step, shape (k, N).
        done: Where the latest step has ended the task, shape (N,).
        actions: Those of this step and of the one before, environments first.
        variables: The episode variables by name, environments last.
        before: The same before the step.
    """

    def __init__(self, env: FMUEnv, quantities: Episode, ended: MaskArray) -> None:
        self._width, self.quantities = env.interface.output_count, quantities
        self._n = len(ended)
        self.ended, self.parameters = ended, quantities.parameters
        self.given = np.zeros_like(quantities.inputs)
        self.kept, self.done = np.zeros_like(quantities.outputs), np.zeros(self._n, np.bool_)
        self.actions = _copied(quantities.action), _copied(quantities.previous_action)
        self.variables: dict[str, npt.NDArray[Any]] = {}
        self.before: dict[str, npt.NDArray[Any]] = {}

    def hold(self, types: Mapping[str, np.dtype[Any]]) -> None:
        """Make the arrays of the episode variables in these types, by name."""
        self.variables, self.before = {}, {}
        for name, dtype in types.items():
            row = array_results.variable(name, self.quantities.variables[name], self._n)
            self.variables[name] = np.ascontiguousarray(row, dtype).copy()
            self.before[name] = self.variables[name].copy()
        self.show()

    def take_back(self, before: Mapping[str, npt.NDArray[Any]]) -> None:
        """Keep values of variables before the step, in other types and shapes than now."""
        every = np.ones(self._n, np.bool_)
        for name, values in before.items():
            array_results.restore_variable(name, self.before[name], every, values)

    def show(self) -> None:
        """Show hooks the arrays that the pool keeps."""
        read, width = self.quantities, self._width
        read.action, read.previous_action = (np.moveaxis(a, 0, -1) for a in self.actions)
        self.kept[:width] = read.previous_state
        read.previous_state = self.kept[:width]
        self.done[:] = read.done
        read.done = self.done
        read.variables.update(self.variables)

    def keep_done(self, done: MaskArray) -> None:
        """Keep which tasks have ended, which a hook on arrays has told."""
        self.done[:] = done
        self.quantities.done = self.done

    def find(self, row: Row) -> Any:
        """The array of a row that a program loads or stores."""
        kind, *rest = row
        index: Any = rest[-1]
        name: Any = rest[0]
        match kind:
            case "output" | "input":
                return getattr(self.quantities, f"{kind}s")[index]
            case "kept" | "given":
                return getattr(self, kind)[index]
            case "parameter":
                return self.parameters[name]
            case "step_count":
                return self.quantities.step_count
            case "done" | "ended":
                return getattr(self, kind)
            case "action" | "previous_action":
                actions = self.actions[kind == "previous_action"]
                return actions.reshape(self._n, -1)[:, index]
            case str() if kind in PREVIOUS:
                return element_row(getattr(self.quantities, kind), index)
        arrays = self.variables if kind == "variable" else self.before
        return arrays[name].reshape(-1, self._n)[index]


def element_row(array: npt.NDArray[Any], index: int) -> npt.NDArray[Any]:
    """The row of an element of a quantity, shape (N,)."""
    row: npt.NDArray[Any] = array.reshape(-1, array.shape[-1])[index]
    return row


def _copied(actions: Any) -> npt.NDArray[Any]:
    """A copy of actions with environments first, in the order of memory."""
    return np.array(np.moveaxis(actions, -1, 0), order="C")


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
