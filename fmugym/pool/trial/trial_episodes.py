"""Episodes of a trial: start values, inputs that move, and the outputs of instances that play them.

There are two episodes to play, 0 and 1, with different start values and different inputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from fmugym.fmi.status import WARNING_CODE, Status
from fmugym.fmi.variable import Variable
from fmugym.pool.licences import require_licence
from fmugym.pool.pool import FloatArray, Pool
from fmugym.pool.pool_spec import PoolSpec

__all__ = ["Inputs", "Limit", "Run", "Starts", "Stretch", "moving_inputs", "play"]

_NUDGE: Final = 0.01
"""How far equal start values of both episodes are moved apart, as a fraction."""

_UNBOUNDED: Final = 1.0
"""How far a Real without limits moves to each side, in its unit."""

_SHIFT: Final = 200
"""By how many steps the inputs of episode 1 are ahead of those of episode 0."""

_BLOCK: Final = 1024
"""How many steps of inputs are made at once."""


# Start values


@dataclass(frozen=True)
class Starts:
    """Start values of both episodes.

    Attributes:
        variables: The P variables that are set before initialization.
        values: Their values, shape (P, 2).
    """

    variables: tuple[Variable, ...] = ()
    values: tuple[tuple[float, float], ...] = ()

    def columns(self, *episodes: int) -> FloatArray:
        """The values of some episodes, shape (P, len(episodes))."""
        return np.array(self.values, np.float64).reshape(-1, 2)[:, episodes]

    def apart(self) -> Starts:
        """The same start values, but Reals that are equal in both episodes are one percent apart.

        An attribute that is set later may change them, although the config does not.
        """
        pairs = zip(self.variables, self.values, strict=True)
        return replace(self, values=tuple(_apart(variable, *pair) for variable, pair in pairs))


def _apart(variable: Variable, first: float, second: float) -> tuple[float, float]:
    if first != second or variable.kind != "real":
        return first, second
    distance = _NUDGE * (abs(first) or abs(variable.nominal or 1.0))
    above, below = first + distance, first - distance
    return first, above if above <= variable.maximum or below < variable.minimum else below


# Inputs


class Inputs:
    """Inputs of both episodes, different in every step.

    Args:
        spec: Names the inputs.
        amplitude: How far they move, as a fraction of the range on each side of the start value.

    Attributes:
        amplitude: As given.
    """

    def __init__(self, spec: PoolSpec, amplitude: float) -> None:
        self._spec, self.amplitude = spec, amplitude
        self._rows = np.zeros((0, len(spec.inputs), 2))

    def until(self, steps: int) -> FloatArray:
        """The inputs of so many steps at least, shape (steps, k_in, 2)."""
        while len(self._rows) < steps:
            done = len(self._rows)
            block = partial(moving_inputs, self._spec, max(_BLOCK, done), self.amplitude)
            both = np.stack([block(done), block(done + _SHIFT)], axis=2)
            self._rows = np.concatenate([self._rows, both])
        return self._rows


def moving_inputs(spec: PoolSpec, steps: int, amplitude: float, first: int = 0) -> FloatArray:
    """Make inputs that move from step to step, each at a different pace.

    Args:
        spec: Names the inputs.
        steps: The number of steps.
        amplitude: How far they move, as a fraction of the range on each side of the start value.
        first: The number of the first step.

    Returns:
        Shape (steps, inputs).
    """
    rows = np.empty((steps, len(spec.inputs)))
    for index, variable in enumerate(spec.inputs):
        pace = 0.7 + 0.31 * index
        swing = amplitude * np.sin(pace * (np.arange(first, first + steps) + 1.0))
        rows[:, index] = _moved(variable, swing)
    return rows


def _moved(variable: Variable, swing: FloatArray) -> FloatArray:
    """Values around the start value that swing up to the upper limit and down to the lower one."""
    (low, high), start = variable.range, variable.start_number
    if low <= high:
        start = min(max(start, low), high)
    if variable.kind == "boolean":
        return np.where(swing > 0.3, 1.0 - start, start)
    if variable.items:
        values = np.array(sorted(value for _, value in variable.items), np.float64)
        other = values[(np.arange(len(swing)) % len(values))]
        return np.where(swing > 0.3, other, start)
    room = _UNBOUNDED if variable.kind == "real" else 1.0
    up = high - start if math.isfinite(high) else room
    down = start - low if math.isfinite(low) else room
    values = start + np.where(swing > 0.0, swing * up, swing * down)
    return np.rint(values) if variable.kind == "integer" else values


# Playing


class Stretch(NamedTuple):
    """Steps of all instances, before which some of them begin an episode.

    Attributes:
        begins: For each instance the episode that it begins; None if it goes on.
        steps: How many.
    """

    begins: tuple[int | None, ...]
    steps: int


@dataclass(frozen=True)
class Run:
    """Outputs of an instance in an episode.

    Attributes:
        episode: Which of the two.
        rows: The outputs at its start and after each step, shape (steps + 1, k).
        status: How it ended; a step with a warning counts as one without.
    """

    episode: int
    rows: FloatArray
    status: int = Status.OK

    @property
    def played(self) -> bool:
        """Whether nothing failed."""
        return self.status in (Status.OK, Status.TERMINATED)

    def cut(self, steps: int) -> Run:
        """The same episode, stopped after some steps."""
        if steps + 1 >= len(self.rows):
            return self
        return Run(self.episode, self.rows[: steps + 1])

    def equals(self, other: Run, outputs: npt.NDArray[np.bool_] | None = None) -> bool:
        """Whether another run gave the same, bit by bit.

        Args:
            other: It.
            outputs: Which outputs to compare, shape (k,); None for all.
        """
        one, two = self.rows, other.rows
        if outputs is not None:
            one, two = one[:, outputs], two[:, outputs]
        return self.status == other.status and one.tobytes() == two.tobytes()


class Limit(Protocol):
    """Early end of a stretch."""

    def is_reached(self, steps: int) -> bool:
        """Whether it ends after so many steps; asked after each."""


def play(
    pool: Pool,
    starts: Starts,
    inputs: Inputs,
    stretches: Sequence[Stretch],
    limit: Limit | None = None,
) -> list[list[Run]]:
    """Play episodes.

    Args:
        pool: N instances.
        starts: The start values.
        inputs: The inputs.
        stretches: In the first one, all instances begin an episode.
        limit: What may end them early.

    Returns:
        The runs of each instance.

    Raises:
        LicenceError: If the first instance gets no licence.
    """
    instances = [_Instance(pool, index) for index in range(pool.num_instances)]
    for begins, steps in stretches:
        _begin(pool, starts, begins)
        for one, episode in zip(instances, begins, strict=True):
            if episode is not None:
                one.begin(episode)
        _step(pool, instances, inputs, steps, limit)
    return [[*one.runs, one.run()] for one in instances]


class _Instance:
    """An instance in its episode."""

    def __init__(self, pool: Pool, index: int) -> None:
        self._pool, self._index = pool, index
        self.runs: list[Run] = []
        self.rows: list[FloatArray] = []
        self.episode = self.taken = self.status = 0

    @property
    def ended(self) -> bool:
        return self.status > WARNING_CODE

    def begin(self, episode: int) -> None:
        self.runs += [self.run()] if self.rows else []
        self.episode, self.taken, self.rows = episode, 0, []
        self.note()

    def note(self) -> None:
        self.rows.append(self._pool.outputs[:, self._index].copy())
        self.status = int(self._pool.statuses[self._index])

    def run(self) -> Run:
        return Run(self.episode, np.array(self.rows), self.status if self.ended else Status.OK)


def _begin(pool: Pool, starts: Starts, begins: tuple[int | None, ...]) -> None:
    values = starts.columns(*(episode or 0 for episode in begins))
    mask = np.array([episode is not None for episode in begins])
    if not mask.any():
        return
    pool.reset(starts.variables, values, mask)
    require_licence(pool)


def _step(
    pool: Pool, instances: list[_Instance], inputs: Inputs, steps: int, limit: Limit | None
) -> None:
    """Step the instances whose episodes have not ended."""
    row = pool.inputs
    for count in range(1, steps + 1):
        ended = [one.ended for one in instances]
        if all(ended):
            return
        rows = inputs.until(max(one.taken for one in instances) + 1)
        for index, one in enumerate(instances):
            row[:, index] = rows[one.taken, :, one.episode]
        pool.step(None, np.array(ended) if any(ended) else None)
        for index, one in enumerate(instances):
            if not ended[index]:
                one.taken += 1
                one.note()
        if limit is not None and limit.is_reached(count):
            return
