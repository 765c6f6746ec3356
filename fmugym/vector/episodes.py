"""The episodes of a vector environment: saved, gone on from, and tried out in rollouts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np

from fmugym.env import FMUEnv
from fmugym.errors import ConfigError, SimulationError
from fmugym.fmi.status import WARNING_CODE
from fmugym.pool import Pool
from fmugym.pool.bundle import Bundle, IndexArray
from fmugym.task.saving import scope_of
from fmugym.task.snapshot import Columns, Snapshot, checked_snapshot
from fmugym.vector.engines.engine import Engine
from fmugym.vector.rollouts import (
    Candidates,
    Rollout,
    joined_rollouts,
    roll_out_by_steps,
    tables_of,
)

__all__ = ["Episodes"]


class Episodes:
    """The episodes that N environments are in, in their engine and in their pool.

    Args:
        prototype: The environment whose task all have.
        engine: Has what hooks read.
        pool: Has the FMUs.

    Attributes:
        started: Whether there ever was one.
        is_ready: Whether a step may follow.
    """

    def __init__(self, prototype: FMUEnv, engine: Engine, pool: Pool) -> None:
        self._prototype, self._engine, self._pool = prototype, engine, pool
        self._everywhere = np.arange(pool.num_instances)
        self.started = self.is_ready = False

    def save(self, indices: IndexArray) -> Snapshot:
        """Save the episodes of some environments.

        Raises:
            SimulationError: If real systems stand in for the FMUs, or if an FMU fails.
        """
        bundle = self._pool.save_instances(indices)
        return Snapshot(scope_of(self._prototype), self._engine.columns(indices), bundle)

    def columns_of(self, snapshot: Snapshot) -> Columns:
        """Columns of a snapshot.

        Raises:
            ConfigError: If the snapshot is of another FMU or config.
        """
        return snapshot.columns_for(scope_of(self._prototype))

    def place(self, snapshot: Snapshot, sources: IndexArray) -> None:
        """Let all environments go on from episodes of a snapshot that fits.

        Args:
            snapshot: Has the episodes.
            sources: The episode for each environment, shape (N,).

        Raises:
            SimulationError: If an FMU fails.
        """
        self.restore(snapshot.bundle, sources, self._everywhere)
        self._engine.place(self.columns_of(snapshot), sources, self._everywhere)

    def restore(self, bundle: Bundle, sources: IndexArray, indices: IndexArray) -> None:
        """Restore the FMUs of some environments; their quantities stay.

        Args:
            bundle: The saved FMUs.
            sources: Which of them, shape (M,).
            indices: The environments, shape (M,).

        Raises:
            SimulationError: If an FMU fails.
        """
        statuses = self._pool.restore_instances(bundle, sources, indices)
        for index in indices[statuses[indices] > WARNING_CODE].tolist():
            raise SimulationError(f"environment {index}: {self._pool.failure(index)}")

    @contextmanager
    def returning_to(self, present: Snapshot | None) -> Iterator[None]:
        """Return to the present episodes afterwards, or to none; nothing starts in between."""
        engine = self._engine
        starts_at_ends, engine.starts_at_ends = engine.starts_at_ends, False
        try:
            yield
        finally:
            engine.starts_at_ends = starts_at_ends
            self.is_ready = False
            if present is not None:
                self.place(present, self._everywhere)
                self.is_ready = True

    def assuming(self, data: Any) -> AbstractContextManager[None]:
        """Let hooks read other data inside of a ``with`` block; see ``FMUVectorEnv.rollout``.

        Raises:
            ConfigError: If there is no such data, or the rows make no function of time.
        """
        return self._engine.assuming(tables_of(self._prototype, data), None)

    def start_of_rollout(
        self, snapshot: Snapshot | None, present: Snapshot | None, count: int
    ) -> Snapshot:
        """Start of candidates: the snapshot that was given, or else the present episodes.

        Raises:
            ConfigError: If the snapshot does not fit, or not so many candidates.
            SimulationError: If there is none, or an episode in it has ended.
        """
        if snapshot is None and present is None:
            raise SimulationError("rollout without a snapshot was called before the first reset")
        start = checked_snapshot(present if snapshot is None else snapshot)
        if len(start) not in ((count,) if snapshot is None else (1, count)):
            raise ConfigError(
                f"there are {count} candidates, but {len(start)} episodes where they may begin"
            )
        columns = self.columns_of(start)
        self._engine.require_fit(columns)
        if np.any(columns["ended"]):
            raise SimulationError("an episode where candidates begin has ended: reset it first")
        return start

    def roll_out(self, start: Snapshot, candidates: Candidates) -> Rollout:
        """Let the environments play all candidates, as many at a time as there are environments."""
        with self._engine.assuming(candidates.tables, candidates.offsets):
            parts = [self._roll_out(start, places, candidates) for places in candidates.rounds]
        return joined_rollouts(parts, candidates.count)

    def _roll_out(self, start: Snapshot, places: IndexArray, candidates: Candidates) -> Rollout:
        """Let each environment play the candidate at its place."""
        engine, actions = self._engine, candidates.actions(places)
        self._begin(start, places, candidates)
        first = None if actions is not None else engine.observe(self._everywhere)
        return roll_out_by_steps(engine, candidates.act(actions), candidates.horizon, first)

    def _begin(self, start: Snapshot, places: IndexArray, candidates: Candidates) -> None:
        """Bring all environments to the places where candidates begin."""
        sources = places if len(start) > 1 else np.zeros_like(places)
        self.restore(start.bundle, sources, self._everywhere)
        columns = candidates.seen_in(self.columns_of(start))
        self._engine.place(columns, sources, self._everywhere)
        values = {name: column[places] for name, column in candidates.parameters.items()}
        if values:
            variables = tuple(map(self._prototype.fmu.variable, values))
            self._pool.write(variables, np.stack(list(values.values())))
        self._engine.show(candidates.variables, values)
