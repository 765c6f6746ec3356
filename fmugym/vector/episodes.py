"""Episodes of N environments: their quantities, and the FMUs of their pool."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import numpy.typing as npt

from fmugym.env import FMUEnv
from fmugym.errors import SimulationError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool import Pool
from fmugym.pool.base import FloatArray, MaskArray
from fmugym.pool.bundle import Bundle, IndexArray
from fmugym.task.saving import scope_of
from fmugym.task.snapshot import Columns, Snapshot
from fmugym.vector.arguments import UnknownAttributeError

__all__ = ["Episodes", "attribute"]


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
        raise UnknownAttributeError(str(error)) from None


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
        everywhere: The indices of all environments.
    """

    def __init__(self, prototype: FMUEnv, pool: Pool) -> None:
        self.prototype, self.pool = prototype, pool
        self.ended, self.any_ended = np.zeros(pool.num_instances, np.bool_), False
        self.started = self.is_ready = False
        self.everywhere = np.arange(pool.num_instances)

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
