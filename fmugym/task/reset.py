"""Reset of episodes: the FMUs start, warm-ups run, and hooks read the first quantities."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Protocol

import numpy as np

from fmugym.pool import Pool
from fmugym.pool.base import FloatArray
from fmugym.pool.bundle import IndexArray
from fmugym.pool.licences import require_started
from fmugym.task.episode import Episode
from fmugym.task.episode_start import EpisodeStart, EpisodeValues

__all__ = ["FIRST", "EpisodeReset", "ResetEpisodes"]

FIRST: Final = np.zeros(1, np.int64)
"""The index of the only instance."""


class ResetEpisodes(Protocol):
    """Quantities of the episodes that a reset writes: numbers of one, or arrays of N."""

    def clear(
        self, indices: IndexArray, inputs: list[Any], action: Any, values: EpisodeValues
    ) -> None:
        """Set the quantities of before the first step.

        Args:
            indices: The environments, shape (M,).
            inputs: For each a number, or a row of shape (N,).
            action: Stands for that of a step, the same in all these environments.
            values: The start values.
        """

    def look(self, indices: IndexArray, outputs: FloatArray) -> None:
        """Let hooks read the outputs of episodes that have not stepped yet, shape (k, N)."""

    def some(self, indices: IndexArray) -> Episode:
        """Quantities of some episodes in new arrays, environments on the last axis."""

    def row(self, name: str) -> Any:
        """The values of an episode variable, shape (..., N)."""

    def warmed(self, indices: IndexArray, values: Mapping[str, Any], inputs: FloatArray) -> None:
        """Take the episode variables that a warm-up has written, and its last inputs."""


class EpisodeReset:
    """Reset of the episode of one environment, or of some of N.

    Args:
        env: The environment, or the prototype of N.
        episodes: The quantities of these environments.
        draws: What the values were drawn from.
        values: These values; of N environments, rows.
        indices: The environments, shape (M,).

    Attributes:
        pool: Has their FMUs.
        episodes, draws, values, indices: As given.
    """

    def __init__(
        self,
        env: Any,
        episodes: ResetEpisodes,
        draws: EpisodeStart,
        values: EpisodeValues,
        indices: IndexArray = FIRST,
    ) -> None:
        self._env, self.episodes, self.draws = env, episodes, draws
        self.values, self.indices = values, indices
        self.pool: Pool = env._instance.pool

    def run(self) -> None:
        """Start the FMUs, and show hooks the first quantities of the episodes.

        Raises:
            SimulationError: If an FMU cannot be initialized, or its warm-up fails.
            ConfigError: If an input of a warm-up does not fit its type.
        """
        warm_ups = self._env._warm_ups
        if warm_ups is None:
            self._start(self.indices)
            self._clear()
        else:
            self._clear()
            warm_ups.begin(self)
        self.episodes.look(self.indices, self.pool.outputs)

    def start(self, indices: IndexArray) -> Episode:
        """Start the FMUs of some of the environments before their warm-up.

        Returns:
            What their hooks read, environments on the last axis.
        """
        self._start(indices)
        self.episodes.look(self.indices, self.pool.outputs)
        return self.episodes.some(indices)

    def _start(self, indices: IndexArray) -> None:
        pool, mask = self.pool, None
        if len(indices) < pool.num_instances:
            mask = np.zeros(pool.num_instances, np.bool_)
            mask[indices] = True
        pool.reset(self.draws.model_variables, self.values.start_values, mask)
        if any(pool.statuses.tolist()):
            require_started(pool, indices)

    def _clear(self) -> None:
        """Let hooks read nothing of earlier episodes, but for the outputs."""
        env, given = self._env, self.values.parameters.get
        inputs = [given(name, start) for name, start in env.interface.start_inputs]
        self.episodes.clear(self.indices, inputs, env._conversions.no_action, self.values)
