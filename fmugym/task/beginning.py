"""The beginning of episodes: of a single environment, or of some of N environments.

They share the order, and differ in where values go: numbers, or rows of arrays.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from fmugym.pool import Pool
from fmugym.pool.bundle import IndexArray
from fmugym.pool.licences import require_started
from fmugym.task.episode import Episode
from fmugym.task.episode_start import EpisodeStart, EpisodeValues

__all__ = ["FIRST", "Beginning", "BeginningOfOne"]

FIRST: Final = np.zeros(1, np.int64)
"""The index of the only instance."""


class Beginning(ABC):
    """Episodes that begin with values that were drawn.

    Args:
        env: The environment, or the prototype of N.
        draws: What the values were drawn from.
        episode: These values; of N environments, rows.
        indices: The environments, shape (M,).
    """

    def __init__(
        self, env: Any, draws: EpisodeStart, episode: EpisodeValues, indices: IndexArray = FIRST
    ) -> None:
        self.env, self.draws, self.episode, self.indices = env, draws, episode, indices
        self.pool: Pool = env._instance.pool

    def begin(self) -> None:
        """Start the FMUs, and show hooks the first quantities of the episodes.

        Raises:
            SimulationError: If an FMU cannot be initialized, or its warm-up fails.
            ConfigError: If an input of a warm-up does not fit its type.
        """
        warm_ups = self.env._warm_ups
        if warm_ups is None:
            self._start(self.indices)
            self._forget()
        else:
            self._forget()
            warm_ups.begin(self)
        self.look()

    def start(self, indices: IndexArray) -> Episode:
        """Start the FMUs of some of the environments before their warm-up.

        Returns:
            What their hooks read, environments on the last axis.
        """
        self._start(indices)
        self.look()
        return self.episodes(indices)

    def _start(self, indices: IndexArray) -> None:
        pool, mask = self.pool, None
        if len(indices) < pool.num_instances:
            mask = np.zeros(pool.num_instances, np.bool_)
            mask[indices] = True
        pool.reset(self.draws.model_variables, self.episode.start_values, mask)
        if any(pool.statuses.tolist()):
            require_started(pool, indices)

    def _forget(self) -> None:
        """Let hooks read nothing of earlier episodes, but for the outputs."""
        env, given = self.env, self.episode.parameters.get
        inputs = [given(name, start) for name, start in env.interface.start_inputs]
        self.clear(inputs, env._conversions.no_action)

    @abstractmethod
    def clear(self, inputs: list[Any], action: Any) -> None:
        """Set the quantities of before the first step.

        Args:
            inputs: For each a number, or a row of shape (N,).
            action: Stands for that of a step, the same in all these environments.
        """

    @abstractmethod
    def look(self) -> None:
        """Let hooks read the outputs of episodes that have not stepped yet."""

    @abstractmethod
    def episodes(self, indices: IndexArray) -> Episode:
        """Quantities of some episodes in new arrays, environments on the last axis."""

    @abstractmethod
    def row(self, name: str) -> Any:
        """The values of an episode variable, shape (..., N)."""

    @abstractmethod
    def place(self, values: Mapping[str, Any], indices: IndexArray) -> None:
        """Write episode variables of some environments, which are on the last axis."""


class BeginningOfOne(Beginning):
    """An episode of a single environment that begins."""

    def clear(self, inputs: list[Any], action: Any) -> None:
        """See ``Beginning.clear``."""
        env, episode = self.env, self.episode
        env._episode.begin(inputs, action, episode.parameters, episode.variables)
        env._pictured = None, 0.0

    def look(self) -> None:
        """See ``Beginning.look``."""
        self.env._episode.look(self.env._instance.outputs)

    def episodes(self, indices: IndexArray) -> Episode:
        """See ``Beginning.episodes``."""
        read: Episode = self.env._episode
        return read.mapped(_as_row)

    def row(self, name: str) -> Any:
        """See ``Beginning.row``."""
        return _as_row(self.env._episode.variables[name])

    def place(self, values: Mapping[str, Any], indices: IndexArray) -> None:
        """See ``Beginning.place``; the warm-up has left inputs, too."""
        read = self.env._episode
        for name, row in values.items():
            part = row[..., 0]
            read.variables[name] = part.item() if part.ndim == 0 else part
        read.inputs = tuple(self.env._instance.inputs.tolist())


def _as_row(value: Any) -> Any:
    return np.asarray(value)[..., np.newaxis]
