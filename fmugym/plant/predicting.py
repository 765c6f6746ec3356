"""Predictions of a plant by copies of its FMU, and their errors."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fmugym.baselines.observer import COPIES, Observer, parameters_of_copies
from fmugym.declared import TaskEnv
from fmugym.plant.feed import Feed
from fmugym.plant.plant_actions import PlantActions
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


class Predictions:
    """Copies of the FMU beside a plant, and the observer of MPC, which corrects them.

    They differ in the parameters that the task draws. The one that fits best predicts.

    Args:
        make_env: Makes an environment with the time of the plant, which the caller closes.
        feed: Has what the plant does, and the tags.
        steps: How many steps ahead there are predictions.

    Attributes:
        names: The variables.
        envs: The environments of the copies.
    """

    def __init__(self, make_env: Callable[[], TaskEnv], feed: Feed, steps: int) -> None:
        self._feed = feed
        self.envs = [make_env()] if steps else []
        self._spread = parameters_of_copies(self.envs[0], 0) if steps else {}
        self.envs += [make_env() for _ in range(COPIES - 1 if self._spread else 0)]
        self._written = [PlantActions(env, feed) for env in self.envs]
        self._tags = feed.plant.of(self.envs[0].pool_spec.outputs) if steps else []
        self.names = [tag.name for tag in self._tags]
        # of the errors, by horizon and variable: how many, their sum, and that of their squares
        self._sums = np.zeros((3, steps, len(self.names)))
        self._told: deque[tuple[int, FloatArray]] = deque(maxlen=max(steps, 1))

    def _measured(self) -> FloatArray:
        return np.array([self._feed.values[name][0] for name in self.names])

    def _seen(self) -> FloatArray:
        """Outputs of the copies, shape (n, k)."""
        return np.array([[tag.of_fmu(env.out) for tag in self._tags] for env in self.envs])

    def begin(self) -> dict[str, float]:
        """Begin with the offsets that the plant has now; nothing was foretold for it."""
        for place, env in enumerate(self.envs):
            own = {name: float(values[place]) for name, values in self._spread.items()}
            env.reset(seed=0, options={"model_parameters": own})
        self._observer = Observer(len(self.envs), len(self.names), len(self.names))
        self._told.clear()
        if self.envs:
            self._observer.offsets = self._measured() - self._seen()
            self._tell()
        return dict.fromkeys(self.names, np.nan)

    def _tell(self) -> None:
        """Keep which copy predicts from now on, and its offsets."""
        best = self._observer.best
        self._told.append((best, self._observer.offsets[best]))

    def follow(self) -> dict[str, float]:
        """Go on by a step of the plant.

        Returns:
            What was foretold for this tick at the one before, by name.
        """
        if not self.envs:
            return {}
        for env, written in zip(self.envs, self._written, strict=True):
            *_, terminated, truncated, _ = env.step(written.action())
            if terminated or truncated:  # the FMU has failed
                return self.begin()
        is_new = np.array([name not in self._feed.faults for name in self.names])
        measured, seen = self._measured(), self._seen()
        found = [seen[best] + offsets for best, offsets in reversed(self._told)]
        for place, values in enumerate(found):
            off = np.where(is_new, measured - values, 0.0)
            self._sums[:, place] += [is_new, off, off**2]
        self._observer.follow(np.where(is_new, measured - seen, 0.0))
        self._observer.correct(measured - seen, is_new)
        self._tell()
        return dict(zip(self.names, found[0].tolist(), strict=True))

    def errors(self) -> list[Error]:
        """The errors until now, by variable and horizon."""
        found = []
        for place, ahead in np.argwhere(self._sums[0].T).tolist():
            count, total, squares = self._sums[:, ahead, place].tolist()
            seconds, rms = (ahead + 1) * self._feed.plant.step, math.sqrt(squares / count)
            found.append(Error(self.names[place], seconds, rms, total / count, int(count)))
        return found
