"""The beginning of episodes: of a single environment, or of some of N environments.

They share the order, and differ in where values go: numbers, or rows of arrays.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from fmugym.pool.base import FloatArray
from fmugym.pool.bundle import IndexArray
from fmugym.pool.licences import start_instances
from fmugym.task.episode import Episode, EpisodeDraws
from fmugym.task.readings import Readings

__all__ = ["FIRST", "Beginning", "BeginningOfOne"]

FIRST: Final = np.zeros(1, np.int64)
"""The index of the only instance."""


class Beginning(ABC):
    """Episodes that begin with values that were drawn.

    Args:
        env: The environment, or the prototype of N.
        draws: What the values were drawn from.
        indices: The environments, shape (M,).
        values: The start values in the order of the draws, shape (P, N).
        parameters: The same by name: numbers, or rows of shape (N,).
    """

    def __init__(
        self,
        env: Any,
        draws: EpisodeDraws,
        indices: IndexArray,
        values: FloatArray,
        parameters: Mapping[str, Any],
    ) -> None:
        self.env, self.draws, self.indices = env, draws, indices
        self.values, self.parameters, self.pool = values, parameters, env.inside.pool

    def begin(self) -> None:
        """Start the FMUs, and let hooks read what episodes begin with.

        Raises:
            SimulationError: If an FMU cannot be initialized, or its warm-up fails.
            ConfigError: If an input of a warm-up does not fit its type.
        """
        warm_ups = self.env.inside.warm_ups
        if warm_ups is None:
            start_instances(self.pool, self.draws.model_variables, self.values, self.indices)
            self.forget()
        else:
            self.forget()
            warm_ups.begin(self)
        self.look()

    def start(self, indices: IndexArray) -> Readings:
        """Start the FMUs of some of the environments before their warm-up.

        Returns:
            What their hooks read, environments on the last axis.
        """
        start_instances(self.pool, self.draws.model_variables, self.values, indices)
        self.look()
        return self.readings(indices)

    def forget(self) -> None:
        """Let hooks read nothing of earlier episodes, but for the outputs."""
        inside, given = self.env.inside, self.parameters.get
        self.clear([given(name, start) for name, start in inside.start_inputs], inside.no_action)

    @abstractmethod
    def clear(self, inputs: list[Any], action: Any) -> None:
        """Let hooks read what there is before the first step.

        Args:
            inputs: For each a number, or a row of shape (N,).
            action: Stands for that of a step, the same in all these environments.
        """

    @abstractmethod
    def look(self) -> None:
        """Let hooks read the outputs of episodes that have not stepped yet."""

    @abstractmethod
    def readings(self, indices: IndexArray) -> Readings:
        """What the hooks of some environments read: new arrays, environments on the last axis."""

    @abstractmethod
    def row(self, name: str) -> Any:
        """The values of an episode variable, shape (..., N)."""

    @abstractmethod
    def place(self, values: Mapping[str, Any], indices: IndexArray) -> None:
        """Write episode variables of some environments, which are on the last axis."""


class BeginningOfOne(Beginning):
    """An episode of a single environment that begins.

    Args:
        env: The environment.
        draws: What the values were drawn from.
        episode: These values.
    """

    def __init__(self, env: Any, draws: EpisodeDraws, episode: Episode) -> None:
        super().__init__(env, draws, FIRST, episode.start_values, episode.parameters)
        self._variables = episode.variables
        self._read: Readings = env.inside.readings

    def forget(self) -> None:
        """See ``Beginning.forget``."""
        inside = self.env.inside
        if inside.player is not None:
            inside.player.begin(inside)
        self._read = read = inside.readings
        read.parameters = self.parameters
        if self._variables:
            read.variables.update(self._variables)
        inside.pictured = None, 0.0
        super().forget()

    def clear(self, inputs: list[Any], action: Any) -> None:
        """See ``Beginning.clear``."""
        read = self._read
        read.inputs, read.step_count = tuple(inputs), 0
        read.action = read.previous_action = action
        read.done = read.after_end = False

    def look(self) -> None:
        """See ``Beginning.look``."""
        inside, read = self.env.inside, self._read
        read.values = tuple(inside.output_row.tolist())
        read.state = read.previous_state = read.values[: inside.output_count]

    def readings(self, indices: IndexArray) -> Readings:
        """See ``Beginning.readings``."""
        read: Readings = self._read
        return read.mapped(_as_row)

    def row(self, name: str) -> Any:
        """See ``Beginning.row``."""
        return _as_row(self._read.variables[name])

    def place(self, values: Mapping[str, Any], indices: IndexArray) -> None:
        """See ``Beginning.place``; the warm-up has left inputs, too."""
        for name, row in values.items():
            part = row[..., 0]
            self._read.variables[name] = part.item() if part.ndim == 0 else part
        self._read.inputs = tuple(self.env.inside.input_row.tolist())


def _as_row(value: Any) -> Any:
    return np.asarray(value)[..., np.newaxis]
