"""Trajectories of an FMU in its episodes, and a pool that records them."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.fmi.fmu import FMU
from fmugym.fmi.status import WARNING_CODE
from fmugym.fmi.variable import Variable
from fmugym.pool.native_pool import play_around
from fmugym.pool.opening import PoolOptions, open_pool
from fmugym.pool.pool import FloatArray, MaskArray, Play, Pool, PoolSpec, StatusArray
from fmugym.pool.pool_spec import ResetMethod

__all__ = ["EpisodeTrajectory", "RecordingPool", "Trajectories"]


class EpisodeTrajectory(NamedTuple):
    """EpisodeTrajectory of an episode of an FMU, or of its beginning.

    Attributes:
        starts: The values set before initialization, shape (p,).
        inputs: Inputs of T steps, shape (T, m).
        outputs: Outputs at the start and after each step, shape (T + 1, k).
    """

    starts: FloatArray
    inputs: FloatArray
    outputs: FloatArray

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.inputs)


class Trajectories:
    """Trajectories of an FMU; as the ``backend`` of environments, the object keeps their episodes.

    Attributes:
        spec: Specification of a step; None before there is one.
        variables: P variables that are set before initialization.
        steps: Steps of all instances, warm-ups included.
    """

    spec: PoolSpec | None = None
    variables: tuple[Variable, ...] = ()
    steps: int = 0

    def __init__(self) -> None:
        self._open: list[_Open] = []

    def open_pool(
        self,
        fmu: FMU,
        spec: PoolSpec,
        num_instances: int,
        log: logging.Logger,
        options: PoolOptions,
    ) -> RecordingPool:
        """Open a pool of the FMU that is recorded; see ``fmugym.pool.opening.open_pool``."""
        self.spec = spec
        options = replace(options, backend="auto")
        return RecordingPool(open_pool(fmu, spec, num_instances, log, options), spec, self)

    def begin(self, starts: FloatArray, outputs: FloatArray) -> _Open:
        """Start to record a trajectory, to which ``RecordingPool`` adds steps."""
        self._open.append(_Open(starts.copy(), [], [outputs.copy()]))
        return self._open[-1]

    def all(self) -> list[EpisodeTrajectory]:
        """All trajectories until now, also the ones without a step."""
        width = 0 if self.spec is None else len(self.spec.inputs)
        return [
            EpisodeTrajectory(starts, np.reshape(inputs, (len(inputs), width)), np.array(outputs))
            for starts, inputs, outputs in self._open
        ]


class _Open(NamedTuple):
    """EpisodeTrajectory of an episode that is not over."""

    starts: FloatArray
    inputs: list[FloatArray]
    outputs: list[FloatArray]


class RecordingPool(Pool):
    """Pool that keeps the trajectories of another pool.

    Args:
        pool: Steps the FMU.
        spec: Specification of a step.
        trajectories: Collection of the trajectories.
    """

    def __init__(self, pool: Pool, spec: PoolSpec, trajectories: Trajectories) -> None:
        self._pool, self._spec, self._trajectories = pool, spec, trajectories
        self.num_instances, self.step_own = pool.num_instances, self._step_own
        self.execution = pool.execution
        self.inputs, self.outputs = pool.inputs, pool.outputs
        self.statuses, self.observations = pool.statuses, pool.observations
        self._now: list[Any] = [None] * pool.num_instances

    def reset(
        self, variables: tuple[Variable, ...], values: FloatArray, mask: MaskArray | None = None
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.reset``."""
        self._pool.reset(variables, values, mask)
        self._trajectories.variables = variables
        for index in _places(mask, self.num_instances):
            started = self.statuses[index] <= WARNING_CODE
            row = values[:, index], self.outputs[:, index]
            self._now[index] = self._trajectories.begin(*row) if started else None
        return self.outputs, self.statuses

    def step(
        self,
        inputs: FloatArray | None = None,
        skip: MaskArray | None = None,
    ) -> tuple[FloatArray, StatusArray]:
        """See ``Pool.step``."""
        self._pool.step(inputs, skip)
        for index in _places(None if skip is None else ~skip, self.num_instances):
            self._trajectories.steps += 1
            if self.statuses[index] > WARNING_CODE:
                self._now[index] = None
            if self._now[index] is not None:
                self._now[index].inputs.append(self.inputs[:, index].copy())
                self._now[index].outputs.append(self.outputs[:, index].copy())
        return self.outputs, self.statuses

    def _step_own(self) -> int:
        self.step()
        return int(np.count_nonzero(self.statuses > WARNING_CODE))

    def prepare_play(self, variables: tuple[Variable, ...], *parts: Any) -> Play:
        """See ``Pool.prepare_play``."""
        return play_around(self, self._spec, variables, *parts)

    # As of the pool that steps the FMU.

    def failure(self, index: int) -> str:
        """See ``Pool.failure``."""
        return self._pool.failure(index)

    def read(self, variables: tuple[Variable, ...]) -> FloatArray:
        """See ``Pool.read``."""
        return self._pool.read(variables)

    def write(self, variables: tuple[Variable, ...], values: FloatArray) -> None:
        """See ``Pool.write``."""
        self._pool.write(variables, values)

    def health(self) -> dict[str, npt.NDArray[np.int64]]:
        """See ``Pool.health``."""
        return self._pool.health()

    def forget_health(self) -> None:
        """See ``Pool.forget_health``."""
        self._pool.forget_health()

    def note_fault(self, index: int) -> None:
        """See ``Pool.note_fault``."""
        self._pool.note_fault(index)

    @property
    def reset_method(self) -> ResetMethod:
        """See ``Pool.reset_method``."""
        return self._pool.reset_method

    def close(self) -> None:
        """See ``Pool.close``."""
        self._pool.close()


def _places(mask: MaskArray | None, count: int) -> list[int]:
    """The instances in a mask, or all."""
    return list(range(count)) if mask is None else np.flatnonzero(mask).tolist()
