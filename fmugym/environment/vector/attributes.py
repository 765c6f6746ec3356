"""Attributes, parameters and methods of the single environments of a vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from fmugym.checks import check_text
from fmugym.environment.construction import draws_of
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import READABLE
from fmugym.environment.fmu_variables import checked_column, spread
from fmugym.environment.vector.arguments import UnknownAttributeError
from fmugym.environment.vector.tasks import VectorTask
from fmugym.errors import ConfigError, SimulationError, shown, unknown_name
from fmugym.pool.pool import FloatArray

__all__ = ["Attributes", "require_settable"]

_TOGETHER: Final = frozenset({"close", "reset", "step"})
"""Methods that one environment cannot do alone."""

_KEPT_FOR_ALL: Final = frozenset(READABLE) | {
    *("action_space", "config", "fmu", "logger", "metadata", "observation_space"),
    *(
        "render_mode",
        "spec",
        "interface",
        "pool_spec",
        "given_backend",
        "given_isolation",
        "pool",
        "episode_start",
    ),
    *("formulas", "resolved", "step_limit", "warm_up", "warm_up_steps", "planning_model"),
}
"""Attributes that ``FMUEnv`` sets itself."""

_NAME: Final = "the name of an attribute"


def require_settable(name: str) -> None:
    """Refuse to set an attribute that the environments themselves keep.

    Raises:
        ConfigError: If the name is one of ``FMUEnv``'s own.
    """
    declared = any(name in vars(cls).get("__annotations__", ()) for cls in FMUEnv.__mro__)
    if name in _KEPT_FOR_ALL or hasattr(FMUEnv, name) or declared:
        raise ConfigError(f"{name!r} cannot be set: every environment keeps it itself")


class Attributes:
    """Attributes and methods of the environments, for ``get_attr``, ``set_attr`` and ``call``.

    Args:
        task: That of the environments, whose episodes keep the values.
    """

    def __init__(self, task: VectorTask) -> None:
        self._task, self._episodes = task, task.episodes
        self._prototype = task.episodes.prototype

    def read(self, name: str, indices: Sequence[int]) -> list[Any]:
        """Read an attribute, or else a parameter, of some environments.

        Raises:
            ConfigError: If there is nothing of this name (it is an ``AttributeError``, too).
        """
        name = check_text(_NAME, name)
        return [self._episodes.read(name, index) for index in indices]

    def call(
        self, name: str, indices: Sequence[int], args: Sequence[Any], kwargs: Mapping[str, Any]
    ) -> list[Any]:
        """Call a method of some environments; see ``FMUVectorEnv.call``."""
        name = check_text(_NAME, name)
        if name in _TOGETHER:
            raise ConfigError(f"{name!r} cannot be called on single environments of many")
        if name == "render":
            return self.render(indices)
        return self._episodes.call(name, indices, args, kwargs)

    def render(self, indices: Sequence[int]) -> list[Any]:
        """Draw some environments; all have the same renderer.

        Raises:
            SimulationError: Before the first reset.
        """
        if self._prototype.render_mode is None:
            return [None for _ in indices]
        if not self._episodes.started:
            raise SimulationError("render was called before the first reset")
        first, pictures = self._prototype, []
        for index in indices:
            with self._episodes.single(index) as env:
                env._renderer = env._renderer or first._renderer
                pictures.append(env.render())
                first._renderer = env._renderer
        return pictures

    def set(self, name: str, values: Any) -> None:
        """Set an attribute, or a parameter, of all environments; see ``FMUVectorEnv.set_attr``."""
        name = check_text(_NAME, name)
        each = self._each(name, values)
        if self.is_parameter(name):
            self._set_parameter(name, each)
        else:
            self.set_attribute(name, dict(enumerate(each)))

    def _numbers(self, name: str, each: Sequence[Any]) -> FloatArray:
        """The values of an episode variable, environments last.

        Raises:
            ConfigError: If they have another shape, or are no finite numbers.
        """
        shape = np.shape(self._prototype.config.variable_starts[name])
        try:
            values = np.array([np.broadcast_to(np.asarray(v, np.float64), shape) for v in each])
        except Exception:  # the values are the caller's
            values = np.array(np.nan)
        if not np.isfinite(values).all():
            raise ConfigError(f"{name!r} takes numbers of shape {shape}, got {shown(each)}")
        return np.moveaxis(values, 0, -1)

    def _each(self, name: str, values: Any) -> list[Any]:
        """The values of all environments in their order."""
        count = len(self._episodes.ended)
        is_row = issubclass(type(values), np.ndarray) and values.ndim > 0
        if not is_row and not issubclass(type(values), list | tuple):
            return [values] * count
        try:
            each = list(values)
        except Exception:  # a list of the caller's whose methods fail
            raise ConfigError(f"{shown(values)} are no values of {shown(name)}") from None
        if len(each) != count:
            raise ConfigError(f"there are {len(each)} values of {shown(name)}, expected {count}")
        return each

    def is_parameter(self, name: str) -> bool:
        """Whether a name is that of a variable of the FMU and not of an attribute."""
        env = self._prototype
        return not hasattr(env, name) and env.fmu.description.find(name) is not None

    def _set_parameter(self, name: str, values: Sequence[Any]) -> None:
        """Set a parameter of all environments, from their next episodes on."""
        draws_of(self._prototype, {name: values[0]})  # it refuses what cannot be set
        scalars = self._prototype.fmu.description.scalars(name)
        rows = [spread(name, scalars, value) for value in values]
        columns = {
            variable: checked_column(variable, [row[place] for row in rows])
            for place, variable in enumerate(scalars)
        }
        for variable, column in columns.items():
            for value in column.tolist():
                self._prototype.interface.within(variable, value)
        try:
            for variable, column in columns.items():
                self._episodes.set_parameter(variable.name, column)
        finally:
            self._task.rebind()

    def set_attribute(self, name: str, values: Mapping[int, Any]) -> None:
        """Set an attribute, or an episode variable, of some environments.

        Args:
            name: An attribute that hooks read, or a variable; expressions read no attributes.
            values: By the number of the environment.

        Raises:
            ConfigError: If there is no such attribute, or every environment keeps it itself.
        """
        env, names = self._prototype, [*self._prototype.fmu.description.variables]
        if name in env.variables:
            drawn = name in env.episode_start.drawn_names
            if drawn and len(values) < len(self._episodes.ended):
                raise ConfigError(f"{name!r} is drawn in each episode: set it for all environments")
            present = [self._episodes.read(name, i) for i in range(len(self._episodes.ended))]
            each = [values.get(index, one) for index, one in enumerate(present)]
            self._episodes.set_variable(name, self._numbers(name, each))
            return
        names += env.variables
        if self._task.has_expressions_only:
            what = "parameter or episode variable, which is all that expressions read,"
            raise UnknownAttributeError(str(unknown_name(what, name, names)))
        if not hasattr(env, name):  # no hook can know of it: the name is misspelt
            names += [known for known in dir(env) if not known.startswith("_")]
            raise UnknownAttributeError(str(unknown_name("attribute or parameter", name, names)))
        require_settable(name)
        self._episodes.set_attribute(name, values)
