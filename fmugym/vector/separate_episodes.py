"""Episodes of N environments, each of which keeps its own quantities as numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.pool.base import FloatArray, Pool
from fmugym.pool.bundle import IndexArray
from fmugym.task.construction import draws_of, prepare_hooks
from fmugym.task.saving import columns_of, note_attributes, place_columns
from fmugym.task.snapshot import Columns, stacked
from fmugym.vector.episodes import Episodes
from fmugym.vector.pool_column import PoolColumn
from fmugym.vector.quantity_arrays import take

__all__ = ["SeparateEpisodes"]


class SeparateEpisodes(Episodes):
    """Episodes of N environments, each on its column of one pool.

    Args:
        envs: The environments; the first one is the prototype.
        pool: Their pool of N instances.

    Attributes:
        envs: As given.
    """

    def __init__(self, envs: Sequence[FMUEnv], pool: Pool) -> None:
        super().__init__(envs[0], pool)
        self.envs = envs
        for index, env in enumerate(envs):
            env._use(PoolColumn(pool, index))
            prepare_hooks(env)  # its constructor may have changed the spaces

    def columns(self, indices: IndexArray) -> Columns:
        """See ``Episodes.columns``."""
        parts = [columns_of(self.envs[index]) for index in indices.tolist()]
        return stacked(parts) | {"ended": self.ended[indices]}

    def place(self, columns: Columns, sources: IndexArray, indices: IndexArray) -> None:
        """See ``Episodes.place``."""
        for source, index in zip(sources.tolist(), indices.tolist(), strict=True):
            place_columns(self.envs[index], columns, source)
            self.ended[index] = columns["ended"][source]
        self.any_ended = bool(self.ended.any())

    def seed_of(self, index: int) -> int | None:
        """See ``Episodes.seed_of``."""
        return self.envs[index].np_random_seed

    def close(self) -> None:
        """See ``Episodes.close``."""
        for env in self.envs:
            env.close()

    @contextmanager
    def single(self, index: int) -> Iterator[FMUEnv]:
        """See ``Episodes.single``."""
        yield self.envs[index]

    def call(
        self,
        name: str,
        indices: Sequence[int],
        arguments: Sequence[Any],
        keywords: Mapping[str, Any],
    ) -> list[Any]:
        """See ``Episodes.call``."""
        values = [self.read(name, index) for index in indices]
        returned = [v(*arguments, **keywords) if callable(v) else v for v in values]
        for index in indices:
            note_attributes(self.envs[index])
        return returned

    def evaluate(
        self, function: Callable[[Any], Sequence[Any]], actions: Any, indices: IndexArray
    ) -> FloatArray:
        """See ``Episodes.evaluate``; the environments know their actions."""
        return np.array([function(self.envs[index]) for index in indices], np.float64).T

    def set_attribute(self, name: str, values: Mapping[int, Any]) -> None:
        """See ``Episodes.set_attribute``; the values may be of any type."""
        for index, value in values.items():
            setattr(self.envs[index], name, value)
            note_attributes(self.envs[index])

    def set_variable(self, name: str, values: FloatArray) -> None:
        """See ``Episodes.set_variable``."""
        for index, env in enumerate(self.envs):
            env.variables[name] = own = take(values, index)
            env._variable_starts = {**env._variable_starts, name: own}
            env.episode_start = draws_of(env)

    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """See ``Episodes.set_parameter``."""
        for index, env in enumerate(self.envs):
            env.interface = env.interface.with_parameter(name, values, index)
            env.episode_start = draws_of(env)

    def show(self, variables: Mapping[str, float], parameters: Mapping[str, FloatArray]) -> None:
        """See ``Episodes.show``."""
        for index, env in enumerate(self.envs):
            env.variables.update(variables)
            if parameters:
                own = {name: float(numbers[index]) for name, numbers in parameters.items()}
                env.parameters = MappingProxyType({**env.parameters, **own})
