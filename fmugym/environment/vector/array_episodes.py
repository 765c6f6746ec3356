"""Episodes of N environments in arrays, which programs, or hooks on arrays, read and write."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from types import MappingProxyType, MethodType
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.environment.actions import array_of
from fmugym.environment.construction import draws_of
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import Episode, standing_in
from fmugym.environment.episode_start import EpisodeStart, EpisodeValues
from fmugym.environment.reset import EpisodeReset
from fmugym.environment.saved_episode import note_attributes
from fmugym.environment.snapshots import Columns, put_back
from fmugym.environment.value_mappings import ParameterValues, ShownParameters
from fmugym.environment.vector import array_results
from fmugym.environment.vector.attributes import require_settable
from fmugym.environment.vector.episodes import Episodes, PoolColumn, attribute
from fmugym.environment.vector.quantity_arrays import (
    EpisodeArrays,
    EpisodeColumn,
    batched,
    keep_rows,
    some,
    start_numbers,
    take,
)
from fmugym.environment.vector.random_streams import EpisodeStreams
from fmugym.environment.vector.saved_batch import (
    batch_columns,
    place_batch,
    place_column,
    require_fit,
    which_of,
)
from fmugym.errors import ConfigError, shown
from fmugym.fmi.variable import checked_value, texts_at
from fmugym.pool.pool import FloatArray, MaskArray, Pool
from fmugym.pool.states import IndexArray

__all__ = ["ArrayEpisodes"]


class ArrayEpisodes(Episodes):
    """Episodes of N environments in arrays. The prototype reads them as its own quantities.

    Args:
        prototype: The environment whose task all have.
        pool: Their FMUs.

    Attributes:
        arrays: What steps read and write.
        streams: What episodes are drawn from.
        start_values: The values of the parameters at the start of episodes, a row each.
        start_as_declared: Whether all episodes start with the constants and episode variables of
            the config, which a pool knows.
    """

    def __init__(self, prototype: FMUEnv, pool: Pool) -> None:
        super().__init__(prototype, pool)
        self._n = pool.num_instances
        self.streams = EpisodeStreams(self._n)
        self.start_as_declared = True
        self._has_others = np.zeros(self._n, np.bool_)
        self._variable_starts: dict[str, FloatArray] = {}
        self._columns: dict[str, npt.NDArray[Any]] = {}
        self._given: dict[str, npt.NDArray[Any]] = {}
        self._strings = prototype.fmu.description.strings
        prototype._episode = batched(prototype, self._n, pool)
        prototype._was_reset = True  # for the calls on single environments
        self._make_parameters(prototype.episode_start)
        self.arrays = EpisodeArrays(prototype, prototype._episode, self.ended)

    def _make_parameters(self, draws: EpisodeStart) -> None:
        self.start_values = np.repeat(draws.constants[:, None], self._n, axis=1)
        self._parameters = ParameterValues(
            zip(draws.parameter_names, self.start_values, strict=True)
        )
        self._texts = {name: self._with_own(texts) for name, texts in draws.strings.items()}
        shown = ShownParameters(self._parameters, self._texts)
        self.prototype.parameters = MappingProxyType(shown if self._strings else self._parameters)

    def _with_own(self, texts: Sequence[str]) -> npt.NDArray[np.object_]:
        """The texts that a String draws from, and a place for an own one of each environment."""
        return np.array([*texts, *[None] * self._n], object)

    def hold(self, types: Mapping[str, np.dtype[Any]]) -> None:
        """Make the arrays of the episode variables in these types, by name."""
        self.arrays.parameters = self._parameters
        self.arrays.hold(types)

    # Starts

    def begin(self, indices: IndexArray, draws: EpisodeStart, drawn: FloatArray) -> None:
        """Start episodes.

        Args:
            indices: The environments, shape (M,).
            draws: What they have drawn from.
            drawn: What they have drawn, shape (draws, M).

        Raises:
            SimulationError: If an FMU cannot be initialized, or its warm-up fails.
        """
        self._place_values(indices, draws, drawn)
        rows = {name: self._parameters[name] for name in draws.parameter_names}
        for name, numbers in self._numbers_of_told_texts(draws, drawn).items():
            rows[name] = np.zeros(self._n)
            rows[name][indices] = numbers
        values = np.array([*rows.values()]).reshape(len(rows), self._n)
        start = EpisodeValues(values, rows, {}, {})
        EpisodeReset(self.prototype, self, draws, start, indices).run()

    def _place_values(self, indices: IndexArray, draws: EpisodeStart, drawn: FloatArray) -> None:
        """Write start values into the rows of the parameters and variables."""
        constants = draws.constant_parameters
        self._put(draws.variable_starts | constants | draws.named(drawn), indices)
        for name, values in self._variable_starts.items():
            self._put({name: values[..., indices]}, indices)
        own = constants.keys() - draws.told.keys()
        self._put({n: row[indices] for n, row in self._given.items() if n in own}, indices)
        for name, numbers in self._numbers_of_told_texts(draws, drawn).items():
            self._put_parameter(name, texts_at(draws.strings[name], numbers), indices)
        self._note_others(indices, draws is not self.prototype.episode_start)

    def _numbers_of_told_texts(self, draws: EpisodeStart, drawn: FloatArray) -> dict[str, Any]:
        """Strings from options: places among the texts that only these draws know."""
        told = draws.strings.keys() & draws.told.keys()
        numbers = draws.constant_parameters | draws.named(drawn) if told else {}
        return {name: numbers[name] for name in told}

    def _note_others(self, indices: IndexArray | slice, others: bool) -> None:
        """Note which environments have other constants: from options, or from a snapshot."""
        self._has_others[indices] = others
        self._settle_starts()

    def _settle_starts(self) -> None:
        self.start_as_declared = not self._variable_starts and not self._has_others.any()

    def clear(
        self, indices: IndexArray, inputs: list[Any], action: Any, values: EpisodeValues
    ) -> None:
        """See ``fmugym.environment.reset.ResetEpisodes``; parameters and variables are there."""
        read = self.arrays.quantities
        for row, value in zip(read.inputs, inputs, strict=True):
            row[indices] = value[indices] if isinstance(value, np.ndarray) else value
        read.action[..., indices] = np.asarray(action)[..., np.newaxis]
        start_numbers(read, indices)

    def look(self, indices: IndexArray, outputs: FloatArray) -> None:
        """See ``ResetEpisodes.look``."""
        keep_rows(self.arrays.quantities, indices)

    def some(self, indices: IndexArray) -> Episode:
        """See ``ResetEpisodes.some``."""
        return some(self.arrays.quantities, indices)

    def warmed(self, indices: IndexArray, values: Mapping[str, Any], inputs: FloatArray) -> None:
        """See ``ResetEpisodes.warmed``."""
        self._put(values, indices)

    def row(self, name: str) -> FloatArray:
        """The values of a parameter or an episode variable, environments last."""
        variables = self.prototype.variables
        if name in variables:
            row: FloatArray = variables[name]
            if type(row) is not np.ndarray or row.shape[-1:] != (self._n,):
                row = variables[name] = array_results.variable(name, row, self._n)
        else:
            known = self._parameters.get(name)
            row = np.full(self._n, np.nan) if known is None else known
            self._parameters[name] = row
        return row

    def _row_for(self, name: str, shape: tuple[int, ...]) -> FloatArray:
        """The row for values of a shape; hooks may have made arrays of what starts as a number."""
        row = self.row(name)
        if shape and row.ndim == 1:
            row = np.array(np.broadcast_to(row, (*shape, self._n)))
            self.prototype.variables[name] = row
        return row

    def _put(self, values: Mapping[str, Any], indices: IndexArray | slice) -> None:
        for name, value in values.items():
            self.row(name)[..., indices] = value

    def _put_parameter(self, name: str, values: Any, indices: IndexArray | slice) -> None:
        """Write values of a parameter as hooks read them."""
        row = self.row(name)
        if name not in self._strings:
            row[indices] = values
            return
        texts, where = self._texts.setdefault(name, self._with_own(())), self.everywhere[indices]
        count, each = len(texts) - self._n, np.broadcast_to(np.asarray(values, object), where.shape)
        known = {text: place for place, text in enumerate(texts[:count].tolist())}
        for index, text in zip(where.tolist(), each, strict=True):
            texts[count + index] = text
            row[index] = known.get(text, count + index)

    # Faults

    def undo(self, mask: MaskArray) -> None:
        """Return to the outputs before the step, and to the variables that ``_update`` wrote."""
        self.pool.outputs[:, mask] = self.arrays.kept[:, mask]
        if self.prototype._own_hooks.update:
            self.restore_variables(mask)
        for index in np.flatnonzero(mask).tolist():
            self.pool.note_fault(index)
        self.pool.halt()

    def restore_variables(self, mask: MaskArray) -> None:
        """Return to the episode variables before the step."""
        for name, values in self.arrays.before.items():
            array_results.restore_variable(name, self.row(name), mask, values)

    # Snapshots

    def columns(self, indices: IndexArray) -> Columns:
        """See ``Episodes.columns``."""
        which = which_of(indices, self._n)
        return batch_columns(self.prototype, which) | {
            "ended": np.array(self.ended[which]),
            **dict(zip(("streams", "seeds"), self.streams.taken(which), strict=True)),
        }

    def require_fit(self, columns: Columns) -> None:
        """See ``Episodes.require_fit``."""
        require_fit(columns)

    def place(self, columns: Columns, sources: IndexArray, indices: IndexArray) -> None:
        """See ``Episodes.place``."""
        count = len(columns["step_count"])
        whence = slice(None) if count == 1 else which_of(sources, count)  # one is placed in all
        where = which_of(indices, self._n)
        place_batch(self.prototype, columns, whence, where)
        for name, values in (columns["parameters"] | columns["variables"]).items():
            if name in self._strings:
                self._put_parameter(name, np.array(values, object)[whence], where)
            else:
                place_column(self._row_for(name, np.shape(values)[1:]), values, whence, where)
        if isinstance(columns["streams"], np.ndarray):
            seeds = np.array(columns["seeds"], object)[whence]
            self.streams.put(where, columns["streams"][whence], seeds)
        self.streams.require_seeds()
        self.ended[where] = columns["ended"][whence]
        self.any_ended = bool(np.count_nonzero(self.ended))
        self._note_others(indices, self._has_other_constants(columns["parameters"]))

    def _has_other_constants(self, columns: Mapping[str, Any]) -> bool:
        """Whether parameters that are placed are not all the usual ones."""
        draws = self.prototype.episode_start
        own = all(
            (np.asarray(columns[name]) == value).all()
            for name, value in draws.constants_shown.items()
            if name in columns
        )
        return not own or not columns.keys() <= set(draws.parameter_names)

    def show(self, variables: Mapping[str, float], parameters: Mapping[str, FloatArray]) -> None:
        """See ``Episodes.show``."""
        self._put({**variables, **parameters}, slice(None))
        if parameters:
            self._note_others(slice(None), True)

    # Single environments

    def seed_of(self, index: int) -> int | None:
        """See ``Episodes.seed_of``."""
        return self.streams.seed_of(index)

    def close(self) -> None:
        """See ``Episodes.close``."""
        self.prototype.close()

    def set_variable(self, name: str, values: FloatArray) -> None:
        """See ``Episodes.set_variable``."""
        self._put({name: values}, slice(None))
        self._variable_starts[name] = values
        self._settle_starts()

    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """See ``Episodes.set_parameter``; the arrays of the parameters are new ones."""
        env, before = self.prototype, self.prototype.parameters
        env.interface = env.interface.with_parameter(name, values, 0)
        variable = env.interface.parameter_variables[name]
        self._given[name] = np.array([checked_value(variable, one) for one in values.tolist()])
        env.episode_start = draws_of(env)
        self._make_parameters(env.episode_start)
        for known in before.keys() & self._parameters.keys():
            self._put_parameter(known, before[known], slice(None))
        self._note_others(slice(None), True)

    @contextmanager
    def single(self, index: int) -> Iterator[FMUEnv]:
        """See ``Episodes.single``; the prototype stands in for the environment.

        So objects that it holds, and that refer to it, read the same values as its methods.
        """
        env = self.prototype
        own = {name: take(row, index) for name, row in self._columns.items()}
        with standing_in(env, EpisodeColumn(env._episode, index)):
            try:
                _set_all(env, own)
                env._instance.pool = PoolColumn(self.pool, index)
                yield env
            finally:
                _set_all(env, self._columns)
                env._instance.pool = self.pool

    def read(self, name: str, index: int) -> Any:
        """See ``Episodes.read``; a method that is called later reads the values of that moment."""
        value = super().read(name, index)
        if isinstance(value, MethodType) and value.__self__ is self.prototype:
            return partial(self._call_one, name, index)
        return value

    def _call_one(self, name: str, index: int, *arguments: Any, **keywords: Any) -> Any:
        return self.call(name, [index], arguments, keywords)[0]

    def call(
        self,
        name: str,
        indices: Sequence[int],
        arguments: Sequence[Any],
        keywords: Mapping[str, Any],
    ) -> list[Any]:
        """See ``Episodes.call``."""
        held = self.arrays.variables
        before = {variable: row.copy() for variable, row in held.items()}
        returned, assigned = [], defaultdict[str, dict[int, Any]](dict)
        try:
            for index in indices:
                with self.single(index) as env:
                    result, attributes = _called(env, name, arguments, keywords)
                returned.append(result)
                for own, value in attributes.items():
                    assigned[own][index] = value
            self._assign({own: self._of_all(own, values) for own, values in assigned.items()})
        except BaseException:
            for variable, row in before.items():
                held[variable][...] = row
            raise
        return returned

    def set_attribute(self, name: str, values: Mapping[int, Any]) -> None:
        """See ``Episodes.set_attribute``; values may only differ if they are numbers."""
        self._assign({name: self._of_all(name, values)})

    def _of_all(self, name: str, values: Mapping[int, Any]) -> tuple[Any, bool]:
        """The value for all environments, and whether it is an array with one for each."""
        if len(values) < self._n:
            present = {i: self.read(name, i) for i in range(self._n)}
            values = {**present, **values}
        each = [values[index] for index in range(self._n)]
        if all(value is each[0] for value in each):
            return each[0], False
        return _row_of(name, each), True

    def _assign(self, attributes: Mapping[str, tuple[Any, bool]]) -> None:
        for name, (value, is_row) in attributes.items():
            setattr(self.prototype, name, value)
            self._columns.pop(name, None)
            if is_row:
                self._columns[name] = value
        note_attributes(self.prototype)

    def evaluate(
        self, function: Callable[[Any], Sequence[Any]], actions: Any, indices: IndexArray
    ) -> FloatArray:
        """See ``Episodes.evaluate``."""
        env = self.prototype
        latest = env._episode.replaced(action=np.moveaxis(np.asarray(actions), 0, -1))
        with standing_in(env, some(latest, indices)):
            rows = function(env)
        return np.array([np.broadcast_to(row, len(indices)) for row in rows], np.float64)


def _called(
    env: FMUEnv, name: str, arguments: Sequence[Any], keywords: Mapping[str, Any]
) -> tuple[Any, dict[str, Any]]:
    """Call a method of one environment, for which the prototype stands in.

    Returns:
        What it returns, or the attribute if it is no method; and the attributes that it has
        assigned, which the prototype does not keep.

    Raises:
        ConfigError: If it assigns what environments keep themselves.
    """
    before = dict(vars(env))
    try:
        value = attribute(env, name)
        result = value(*arguments, **keywords) if callable(value) else value
        own = {n: v for n, v in vars(env).items() if n not in before or v is not before[n]}
        for assigned in own:
            require_settable(assigned)
        return result, own
    finally:
        put_back(env, before)


def _set_all(env: FMUEnv, attributes: Mapping[str, Any]) -> None:
    for name, value in attributes.items():
        setattr(env, name, value)


def _row_of(name: str, values: list[Any]) -> npt.NDArray[Any]:
    row = array_of(values)
    if row.ndim != 1 or row.dtype.kind not in "biuf":
        raise ConfigError(f"{name!r} can hold one number for each environment, got {shown(values)}")
    return row
