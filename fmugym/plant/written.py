"""What acts in a plant, as actions and inputs of an environment."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fmugym.archive.variable import Variable
from fmugym.declared import TaskEnv
from fmugym.errors import ConfigError, shown
from fmugym.logs import Actions
from fmugym.plant.feed import Feed
from fmugym.plant.tags import Plant, in_fmu, tagged
from fmugym.pool.base import FloatArray
from fmugym.task.actions import flat_inputs

__all__ = ["Written", "lacking_tag"]


def lacking_tag(name: str) -> ConfigError:
    """Say that a plant has no tag for a variable that the task needs."""
    return ConfigError(f"[plant] has no tag for {name!r}, which the task needs")


class Written:
    """What acts in a plant, in the place of what an environment would write.

    Args:
        env: The environment. Its hook ``_get_inputs`` becomes one that reads the plant.
        feed: Has what acts.
        plant: Has the tags.

    Raises:
        ConfigError: If an action has no tag.
    """

    def __init__(self, env: TaskEnv, feed: Feed, plant: Plant) -> None:
        self._feed, self._inputs = feed, env.inside.spec.inputs
        known = in_fmu(env)
        for alias in env.task.root.child("agent").child("actions").value or ():
            if alias in known and alias not in plant.tags:
                raise lacking_tag(alias)
        self._tags = tagged(env, plant, self._inputs)
        self.actions = Actions(env, self._range_of, math.inf)
        self._own = env._get_inputs
        # the hook of this one environment, whatever its class
        env._get_inputs = self._get_inputs  # type: ignore[method-assign]
        self.names = [alias for _, alias, _ in self._tags]

    def _get_inputs(self) -> FloatArray:
        return self.over(flat_inputs(self._own(), self._inputs, shown))

    def over(self, values: FloatArray) -> FloatArray:
        """The inputs with what acts in the plant, in the FMU's units."""
        for place, alias, conversion in self._tags:
            values[place] = conversion.inverse(self._feed.values[alias][0])
        return values

    def action(self) -> Any:
        """The action that comes nearest to what acts in the plant."""
        values = self.over(np.zeros(len(self._inputs)))
        row = dict(zip([one.name for one in self._inputs], values.tolist(), strict=True))
        return self.actions.of(row, self._feed.time)

    def proposed(self, action: Any) -> dict[str, float]:
        """What an action would write, in the task's units."""
        values = self.actions.inputs(action)
        return {alias: float(conversion(values[place])) for place, alias, conversion in self._tags}

    def _range_of(self, variable: Variable) -> float:
        """How far apart the values of an input are; refuses one that no tag tells."""
        if variable.name not in {self._inputs[place].name for place, *_ in self._tags}:
            raise lacking_tag(variable.name)
        width = variable.maximum - variable.minimum
        return width if math.isfinite(width) and width > 0 else 1.0
