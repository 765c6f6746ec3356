"""Episodes of N environments: their quantities, and the FMUs of their pool.

``SeparateEpisodes`` keep the quantities of each environment as numbers of its own. ``PoolColumn``
is one instance of a pool, as a pool of one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.environment.construction import draws_of, prepare_hooks
from fmugym.environment.env import FMUEnv
from fmugym.environment.saved_episode import columns_of, note_attributes, place_columns, scope_of
from fmugym.environment.snapshots import Columns, Snapshot, stacked
from fmugym.environment.vector.arguments import UnknownAttributeError
from fmugym.environment.vector.quantity_arrays import take
from fmugym.errors import SimulationError, reason
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.variable import Variable
from fmugym.pool import Pool
from fmugym.pool.pool import FloatArray, MaskArray, StatusArray
from fmugym.pool.pool_spec import ResetMethod
from fmugym.pool.states import Bundle, IndexArray, SaveMethod

__all__ = ["Episodes", "PoolColumn", "SeparateEpisodes", "attribute"]


class PoolColumn(Pool):
    """One instance as a ``Pool``. Steps and resets do not touch the other instances.

    Args:
        pool: The pool of N instances.
        index: The index of the instance.
    """

    num_instances = 1

    def __init__(self, pool: Pool, index: int) -> None:
        self._pool, self._index = pool, index
        self._part = part = slice(index, index + 1)
        self.inputs: FloatArray = pool.inputs[:, part]
        self.outputs: FloatArray = pool.outputs[:, part]
        self.statuses: StatusArray = pool.statuses[part]
        self.observations = pool.observations[part]

    def _others(self) -> MaskArray:
        mask = np.ones(self._pool.num_instances, np.bool_)
        mask[self._index] = False
        return mask

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        all_values = np.repeat(values, self._pool.num_instances, axis=1)
        self._pool.reset(variables, all_values, ~self._others())
        return self.outputs, self.statuses

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        if inputs is not None:
            self.inputs[:] = inputs
        self._pool.step(None, self._others())
        return self.outputs, self.statuses

    def step_own(self) -> int:
        """See ``Pool.step_own``."""
        self.step()
        return int(self.statuses[0] > WARNING_CODE)

    @property
    def save_method(self) -> SaveMethod | None:
        """See ``Pool.save_method``."""
        return self._pool.save_method

    def save_instances(self, indices: IndexArray) -> Bundle:
        """See ``Pool.save_instances``."""
        return self._pool.save_instances(indices + self._index)

    def restore_instances(
        self, bundle: Bundle, sources: IndexArray, indices: IndexArray
    ) -> StatusArray:
        """See ``Pool.restore_instances``."""
        self._pool.restore_instances(bundle, sources, indices + self._index)
        return self.statuses

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        return self._pool.failure(self._index)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        return self._pool.read(variables)[:, self._part]

    def health(self) -> dict[str, npt.NDArray[np.int64]]:
        """See ``Pool.health``."""
        return {name: counts[self._part] for name, counts in self._pool.health().items()}

    def forget_health(self) -> None:
        """See ``Pool.forget_health``; this affects the counts of all instances."""
        self._pool.forget_health()

    @property
    def is_real(self) -> bool:
        """See ``Pool.is_real``."""
        return self._pool.is_real

    @property
    def reset_method(self) -> ResetMethod:
        """See ``Pool.reset_method``."""
        return self._pool.reset_method

    def halt(self) -> None:
        """See ``Pool.halt``; the other instances stop too."""
        self._pool.halt()

    def note_fault(self, index: int) -> None:
        """See ``Pool.note_fault``."""
        self._pool.note_fault(self._index)

    def info(self) -> dict[str, npt.NDArray[Any]]:
        """See ``Pool.info``."""
        return {name: row[self._part] for name, row in self._pool.info().items()}

    def close(self) -> None:
        """Do nothing: the vector environment closes the pool."""


def attribute(env: FMUEnv, name: str) -> Any:
    """Return an attribute of an environment, or else a variable or parameter of its episode.

    Raises:
        ConfigError: If there is none of this name (it is an ``AttributeError``, too).
    """
    if not hasattr(env, name):
        for own in (env.variables, env.parameters):
            if name in own:
                return own[name]
    try:
        return getattr(env, name)
    except AttributeError as error:
        raise UnknownAttributeError(reason(error)) from None


class Episodes(ABC):
    """Episodes of N environments.

    Args:
        prototype: The environment whose task all have.
        pool: Their FMUs.

    Attributes:
        prototype, pool: As given.
        ended: Whether the last step ended the episode, shape (N,); always the same array.
        any_ended: Whether the last step ended any episode.
        started: Whether there ever was one.
        is_ready: Whether a step may follow.
        is_open: Whether the environments are open.
        everywhere: The indices of all environments.
    """

    def __init__(self, prototype: FMUEnv, pool: Pool) -> None:
        self.prototype, self.pool = prototype, pool
        self.ended, self.any_ended = np.zeros(pool.num_instances, np.bool_), False
        self.started = self.is_ready = False
        self.is_open = True
        self.everywhere = np.arange(pool.num_instances)

    def let_step(self) -> None:
        """Let steps follow, unless another thread closes the environments meanwhile."""
        self.started = self.is_ready = True
        if not self.is_open:  # asked afterwards, so that no close comes in between
            self.is_ready = False

    def forbid_steps(self) -> None:
        """Let no step follow from now on, because the environments close."""
        self.is_open = False
        self.is_ready = False

    def note_ends(self, terminated: MaskArray, truncated: MaskArray) -> None:
        """Note which episodes a step has ended."""
        np.logical_or(terminated, truncated, out=self.ended)
        self.any_ended = bool(np.count_nonzero(self.ended))

    def note_starts(self, mask: MaskArray) -> None:
        """Note which episodes have started."""
        self.ended[mask] = False
        self.any_ended = bool(np.count_nonzero(self.ended))

    # Snapshots

    def save(self, indices: IndexArray) -> Snapshot:
        """Save the episodes of some environments.

        Raises:
            ConfigError: If hooks have assigned to attributes of the class.
            SimulationError: If real systems stand in for the FMUs, or if an FMU fails.
        """
        bundle = self.pool.save_instances(indices)
        return Snapshot(scope_of(self.prototype), self.columns(indices), bundle)

    def columns_of(self, snapshot: Snapshot) -> Columns:
        """Columns of a snapshot.

        Raises:
            ConfigError: If the snapshot is of another FMU or config.
        """
        return snapshot.columns_for(scope_of(self.prototype))

    def go_on_from(self, snapshot: Snapshot, sources: IndexArray) -> None:
        """Let all environments go on from episodes of a snapshot that fits.

        Args:
            snapshot: Has the episodes.
            sources: The episode for each environment, shape (N,).

        Raises:
            SimulationError: If an FMU fails.
        """
        self.restore(snapshot.bundle, sources, self.everywhere)
        self.place(self.columns_of(snapshot), sources, self.everywhere)

    def restore(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> None:
        """Restore the FMUs of some environments; their quantities stay.

        Args:
            bundle: The saved FMUs.
            sources: Which of them, shape (M,).
            indices: The environments, shape (M,).

        Raises:
            SimulationError: If an FMU fails.
        """
        statuses = self.pool.restore_instances(bundle, sources, indices)
        for index in indices[statuses[indices] > WARNING_CODE].tolist():
            raise SimulationError(f"environment {index}: {self.pool.failure(index)}")

    @abstractmethod
    def columns(self, indices: IndexArray) -> Columns:
        """Copy the quantities and random streams of some episodes, without the FMUs' states."""

    def require_fit(self, columns: Columns) -> None:
        """Refuse columns that these environments cannot have.

        Raises:
            ConfigError: If there are such columns.
        """
        return

    @abstractmethod
    def place(self, columns: Columns, sources: IndexArray, indices: IndexArray) -> None:
        """Let environments go on from columns; environment ``indices[i]`` from ``sources[i]``."""

    # Single environments

    @abstractmethod
    def seed_of(self, index: int) -> int | None:
        """Return the seed of an environment's generator."""

    @abstractmethod
    def close(self) -> None:
        """Close the environments, but not the pool."""

    @abstractmethod
    def single(self, index: int) -> AbstractContextManager[FMUEnv]:
        """Lend one environment as a single one, to read it and call its methods."""

    def read(self, name: str, index: int) -> Any:
        """Read an attribute, or else a parameter of the FMU, of one environment."""
        with self.single(index) as env:
            return attribute(env, name)

    @abstractmethod
    def call(
        self,
        name: str,
        indices: Sequence[int],
        arguments: Sequence[Any],
        keywords: Mapping[str, Any],
    ) -> list[Any]:
        """Call a method of some environments; attributes that it assigns take effect.

        Raises:
            ConfigError: If a method changes something that all environments must share. Then no
                environment is changed.
        """

    @abstractmethod
    def evaluate(
        self, function: Callable[[Any], Sequence[Any]], actions: Any, indices: IndexArray
    ) -> FloatArray:
        """Evaluate a function of the environment, which reads as hooks do and changes nothing.

        Args:
            function: Returns numbers for a single environment, and arrays of shape (M,) for a
                prototype that stands for M of them.
            actions: The latest actions of all environments, these first.
            indices: The M environments to evaluate it for.

        Returns:
            The values, shape (k, M).
        """

    @abstractmethod
    def set_attribute(self, name: str, values: Mapping[int, Any]) -> None:
        """Set an attribute of some environments, by index.

        Raises:
            ConfigError: If these environments cannot have these values.
        """

    @abstractmethod
    def set_variable(self, name: str, values: FloatArray) -> None:
        """Give an episode variable one value for each environment, now and at each start.

        Args:
            name: The variable.
            values: Environments last.
        """

    @abstractmethod
    def set_parameter(self, name: str, values: npt.NDArray[Any]) -> None:
        """Give a parameter one value for each environment, from its next episode on.

        Args:
            name: The parameter.
            values: Checked values: numbers, or the texts of a String as objects, shape (N,).
        """

    @abstractmethod
    def show(self, variables: Mapping[str, float], parameters: Mapping[str, FloatArray]) -> None:
        """Let hooks of all environments read other values in these episodes.

        Args:
            variables: Those of episode variables, by name.
            parameters: Those of parameters, arrays of shape (N,) by name.
        """


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
