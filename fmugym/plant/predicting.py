"""What a copy of the FMU foretells of a plant, and how wrong that is."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from fmugym.archive.units import Conversion
from fmugym.baselines.observer import COPIES, Observer, spread
from fmugym.declared import TaskEnv
from fmugym.plant.feed import Feed
from fmugym.plant.tags import Plant, in_fmu
from fmugym.plant.written import Written
from fmugym.pool.base import FloatArray

__all__ = ["Error", "Predictions"]


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
    """A copy of the FMU with the inputs of the plant, and some parameters."""

    def __init__(
        self, env: TaskEnv, feed: Feed, plant: Plant, parameters: Mapping[str, float]
    ) -> None:
        self.env, self._written = env, Written(env, feed, plant)
        self._options = {"model_parameters": dict(parameters)}

    def begin(self) -> None:
        self.env.reset(seed=0, options=self._options)

    def step(self) -> bool:
        """Go on by a step; tells whether the FMU has failed."""
        *_, terminated, truncated, _ = self.env.step(self._written.action())
        return bool(terminated or truncated)


class Predictions:
    """Copies of the FMU beside a plant, and the observer of MPC, which corrects them.

    They differ in the parameters that the task draws. The one that fits best predicts.

    Args:
        make_env: Makes an environment with the time of the plant.
        feed: Has what the plant does.
        plant: Has the tags.
        steps: How many steps ahead there are predictions.

    Attributes:
        names: The variables.
        envs: The environments of the copies.
    """

    def __init__(
        self, make_env: Callable[[], TaskEnv], feed: Feed, plant: Plant, steps: int
    ) -> None:
        self._feed, self._plant, self._steps = feed, plant, steps
        self.envs: list[TaskEnv] = []
        self._read: dict[str, tuple[str, Conversion]] = {}
        try:
            self._copies = [*self._made(make_env)] if steps else []
        except BaseException:
            self.close()
            raise
        self.names = list(self._read)
        shape = (steps, len(self.names))
        self._sums, self._squares = np.zeros(shape), np.zeros(shape)
        self._counts = np.zeros(shape, np.int64)
        self._told: deque[tuple[int, FloatArray]] = deque(maxlen=max(steps, 1))

    def _made(self, make_env: Callable[[], TaskEnv]) -> Iterator[_Copy]:
        self.envs.append(make_env())
        values = spread(self.envs[0], 0)
        for _ in range(COPIES - 1 if values else 0):
            self.envs.append(make_env())
        for place, env in enumerate(self.envs):
            own = {name: float(each[place]) for name, each in values.items()}
            yield _Copy(env, self._feed, self._plant, own)
        self._read = {
            alias: (variable.name, conversion)
            for alias, (variable, conversion) in in_fmu(self.envs[0]).items()
            if variable.name in self.envs[0].out and alias in self._plant.tags
        }

    def _measured(self) -> FloatArray:
        return np.array([self._feed.values[name][0] for name in self.names])

    def _seen(self) -> FloatArray:
        """What the copies give, shape (n, k)."""
        return np.array([[c(env.out[n]) for n, c in self._read.values()] for env in self.envs])

    def begin(self) -> None:
        """Begin with the offsets that the plant has now."""
        for copy in self._copies:
            copy.begin()
        self._observer = Observer(len(self._copies), len(self.names), len(self.names))
        self._told.clear()
        if self._copies:
            self._observer.offsets = self._measured() - self._seen()
            self._tell()

    def _tell(self) -> None:
        """Keep which copy predicts from now on, and its offsets."""
        best = self._observer.best
        self._told.append((best, self._observer.offsets[best]))

    def follow(self) -> dict[str, float]:
        """Go on by a step of the plant.

        Returns:
            What was foretold for this tick at the one before, by name.
        """
        if any(copy.step() for copy in self._copies):
            self.begin()
            return dict.fromkeys(self.names, np.nan)
        if not self._copies:
            return {}
        is_new = np.array([name not in self._feed.faults for name in self.names])
        measured, seen = self._measured(), self._seen()
        found = [seen[best] + offsets for best, offsets in reversed(self._told)]
        for place, values in enumerate(found):
            off = np.where(is_new, measured - values, 0.0)
            self._sums[place] += off
            self._squares[place] += off**2
            self._counts[place] += is_new
        self._observer.follow(np.where(is_new, measured - seen, 0.0))
        self._observer.correct(measured - seen, is_new)
        self._tell()
        return dict(zip(self.names, found[0].tolist(), strict=True))

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
        for env in self.envs:
            env.close()
