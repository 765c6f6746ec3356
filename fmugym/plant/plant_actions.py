"""Actions of a plant's own controller, read as actions and inputs of an environment."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.declared import TaskEnv
from fmugym.errors import shown
from fmugym.logs import Actions, declared_as
from fmugym.plant.feed import Feed
from fmugym.pool.base import FloatArray
from fmugym.task.actions import flat_inputs
from fmugym.task.hooks import AssignedHook

__all__ = ["PlantActions"]


class PlantActions:
    """Actions of the plant, in the place of the actions of an environment.

    Args:
        env: The environment. Its hook ``_get_inputs`` becomes one that reads the plant, and so do
            the inputs of its warm-up.
        feed: Has what acts, and the tags.

    Raises:
        ConfigError: If an action has no tag.
    """

    def __init__(self, env: TaskEnv, feed: Feed) -> None:
        self._feed, plant = feed, feed.plant
        self._inputs = {one.name: one for one in env.pool_spec.inputs}
        for alias in env.task.root.child("agent").child("actions").value or ():
            if variable := self._inputs.get(declared_as(env, alias)[0]):
                plant.require(variable, alias)
        self._tags = plant.of(self._inputs.values())
        self.names = [tag.name for tag in self._tags]
        self.actions = Actions(env, self._range_of, math.inf)
        self._own = env._get_inputs
        env._get_inputs = AssignedHook(self._get_inputs)  # type: ignore[method-assign]
        warm_up = env.warm_up
        if warm_up is not None:
            self._of_warm_up = warm_up.inputs
            # that of this one warm-up, which must wait for the plant before the first observation
            warm_up.inputs = self._warm_inputs  # type: ignore[method-assign]

    def _warm_inputs(self, env: Any) -> FloatArray:
        """Fill histories before the first observation: wait, and read the plant's actions."""
        values = self._of_warm_up(env)
        self._feed.advance()
        return self.over(np.array([np.ravel(value)[0] for value in values]))

    def _get_inputs(self) -> FloatArray:
        return self.over(flat_inputs(self._own(), [*self._inputs.values()], shown))

    def over(self, values: FloatArray) -> FloatArray:
        """Replace inputs by the plant's actions, in the FMU's units."""
        acting, pairs = self._feed.row(), zip(self._inputs, values, strict=True)
        return np.array([acting.get(name, value) for name, value in pairs])

    def action(self) -> Any:
        """Action that is closest to the plant's."""
        return self.actions.of(self._feed.row(), self._feed.time)

    def proposed(self, action: Any) -> dict[str, float]:
        """Inputs that an action would write, in the task's units."""
        values = dict(zip(self._inputs, self.actions.inputs(action), strict=True))
        return {tag.name: float(tag.of_fmu(values)) for tag in self._tags}

    def _range_of(self, variable: Variable) -> float:
        """Width of the range of an input; refuses an input without a tag."""
        self._feed.plant.require(variable)
        width = variable.maximum - variable.minimum
        return width if math.isfinite(width) and width > 0 else 1.0
