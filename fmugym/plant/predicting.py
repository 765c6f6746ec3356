"""What a copy of the FMU foretells of a plant, and how wrong that is."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from fmugym.archive.units import conversion_between
from fmugym.declared import TaskEnv
from fmugym.errors import unknown_name
from fmugym.logs import declared_as
from fmugym.plant.feed import Feed
from fmugym.plant.tags import Plant, in_fmu
from fmugym.plant.written import Written
from fmugym.pool.base import FloatArray

__all__ = ["Error", "Predictions"]

_CORRECTION: Final = 0.3
"""By which part offsets follow the differences in a step."""


class Error(NamedTuple):
    """The error of predictions of a variable.

    Attributes:
        name: The variable.
        ahead: How far ahead, in seconds.
        rms: The root of the mean squared error, in the unit of the task.
        bias: The mean of what the plant had beyond the prediction.
        number: How many predictions there were.
    """

    name: str
    ahead: float
    rms: float
    bias: float
    number: int


class _Copy:
    """A copy of the FMU with the inputs of the plant."""

    def __init__(self, env: TaskEnv, feed: Feed, plant: Plant) -> None:
        self.env, self.written = env, Written(env, feed, plant)
        self.age = 0

    def begin(self, states: Mapping[str, float]) -> None:
        self.env.reset(seed=0, options={"model_parameters": dict(states)})
        self.age = 0

    def step(self) -> bool:
        """Go on by a step; tells whether the FMU has failed."""
        *_, terminated, truncated, _ = self.env.step(self.written.action())
        self.age += 1
        return bool(terminated or truncated)


class Predictions:
    """Copies of the FMU beside a plant.

    With ``[plant.states]``, a copy begins anew at each tick, in the states that were measured.
    Otherwise one copy runs beside the plant, and offsets of its outputs, filtered, correct it.

    Args:
        make_env: Makes an environment with the time of the plant.
        feed: Has what the plant does.
        plant: Has the tags.
        steps: How many steps ahead there are predictions.

    Attributes:
        names: The variables.
    """

    def __init__(
        self, make_env: Callable[[], TaskEnv], feed: Feed, plant: Plant, steps: int
    ) -> None:
        self._feed, self._plant, self._steps = feed, plant, steps
        states = plant.entry.child("states")
        count = steps if states.value else min(steps, 1)
        self._copies: list[_Copy] = []
        try:
            for _ in range(count):
                self._copies.append(_Copy(make_env(), feed, plant))
            self._read = dict(self._outputs()) if count else {}
            self._states = {name: self._state(name, e) for name, e in states.items().items()}
        except BaseException:
            self.close()
            raise
        self.names = list(self._read)
        shape = (steps, len(self.names))
        self._sums, self._squares = np.zeros(shape), np.zeros(shape)
        self._counts = np.zeros(shape, np.int64)
        self._offsets: deque[FloatArray] = deque(maxlen=max(steps, 1))
        self._tick = 0

    @property
    def envs(self) -> list[TaskEnv]:
        """The environments of the copies."""
        return [copy.env for copy in self._copies]

    def _outputs(self) -> Iterator[tuple[str, tuple[str, Any]]]:
        """The outputs that have tags: their names in the FMU, and conversions to the task."""
        env = self._copies[0].env
        for alias, (variable, conversion) in in_fmu(env).items():
            if variable.name in env.out and alias in self._plant.tags:
                yield alias, (variable.name, conversion)

    def _state(self, name: str, entry: Any) -> tuple[str, Any]:
        """The parameter of a measured state, and the conversion from the task to its unit."""
        env = self._copies[0].env
        if name not in self._read:
            raise entry.error(unknown_name("measured variable", name, self._read))
        given, _ = declared_as(env, entry.value)
        with entry.placing():
            parameter = env.fmu.description.variable(given)
        variable, conversion = in_fmu(env)[name]
        between = conversion_between(variable.unit, parameter.unit, env.fmu.description.units)
        return given, lambda value: between(conversion.inverse(value))

    def _measured(self) -> FloatArray:
        return np.array([self._feed.values[name][0] for name in self.names])

    def _foretold(self, copy: _Copy) -> FloatArray:
        return np.array([c(copy.env.out[n]) for n, c in self._read.values()], np.float64)

    def begin(self) -> None:
        """Begin in the states of the plant, as far as these are known."""
        self._offsets.clear()
        self._tick = 0
        for copy in self._copies:
            self._restart(copy)
        if self._copies:
            self._offsets.append(self._measured() - self._foretold(self._copies[0]))

    def _restart(self, copy: _Copy) -> None:
        values = self._feed.values
        copy.begin({given: of(values[name][0]) for name, (given, of) in self._states.items()})

    def follow(self) -> dict[str, float]:
        """Go on by a step of the plant.

        Returns:
            What was foretold for this tick at the one before, by name.
        """
        if not self._copies:
            return {}
        failed = [copy for copy in self._copies if copy.step()]
        is_new = np.array([name not in self._feed.faults for name in self.names])
        told = self._compare(is_new)
        for copy in failed:
            self._restart(copy)
        self._tick += 1
        if self._states and not self._states.keys() & self._feed.faults.keys():
            self._restart(self._copies[self._tick % len(self._copies)])
        return dict(zip(self.names, told.tolist(), strict=True))

    def _compare(self, is_new: Any) -> FloatArray:
        """Note errors; return what was foretold a step ago."""
        measured = self._measured()
        if self._states:
            found = {copy.age: self._foretold(copy) for copy in self._copies}
        else:
            plain = self._foretold(self._copies[0])
            found = {j: plain + one for j, one in enumerate(reversed(self._offsets), 1)}
            last = self._offsets[-1]
            moved = last + _CORRECTION * (measured - plain - last)
            self._offsets.append(np.where(is_new, moved, last))
        for ahead, values in found.items():
            if 0 < ahead <= self._steps:
                off = np.where(is_new, measured - values, 0.0)
                self._sums[ahead - 1] += off
                self._squares[ahead - 1] += off**2
                self._counts[ahead - 1] += is_new
        return found.get(1, np.full(len(self.names), np.nan))

    def errors(self) -> list[Error]:
        """The errors until now, by variable and horizon."""
        found = []
        for place, name in enumerate(self.names):
            for ahead in range(self._steps):
                count = int(self._counts[ahead, place])
                if count:
                    rms = float(np.sqrt(self._squares[ahead, place] / count))
                    bias = float(self._sums[ahead, place] / count)
                    found.append(Error(name, (ahead + 1) * self._plant.step, rms, bias, count))
        return found

    def close(self) -> None:
        """Free the copies."""
        for copy in self._copies:
            copy.env.close()
