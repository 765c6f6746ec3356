"""Quantities of an episode: numbers of one environment, or arrays of N, which hooks read.

Recordings have quantities with names, units and limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from fmugym.environment.value_mappings import EpisodeVariables, NamedValues, ParameterValues
from fmugym.errors import ConfigError
from fmugym.expressions.quantities import KEPT, PREVIOUS, QUANTITIES
from fmugym.pool.pool import FloatArray
from fmugym.pool.states import IndexArray

if TYPE_CHECKING:
    from fmugym.environment.episode_start import EpisodeValues

__all__ = [
    "KINDS",
    "READABLE",
    "Episode",
    "NoEpisode",
    "Quantities",
    "Quantity",
    "environments_first",
    "environments_last",
    "read_by",
    "standing_in",
]

KINDS: Final = (
    *("action", "input", "output", "parameter", "memory", "data", "setpoint", "expression"),
)
"""What a quantity may be: an action is an input that the agent writes."""


@dataclass(frozen=True)
class Quantity:
    """A value that has a name.

    Attributes:
        name: The name in the task.
        kind: One of ``KINDS``.
        unit: Its unit; "" if none is known.
        low, high: Its limits in this unit; infinite where there are none.
        holds: Whether a value holds until the next one, as that of a schedule.
        of: The quantity that this one is a set point of; "" if there is none.
    """

    name: str
    kind: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    holds: bool = False
    of: str = ""


class Quantities(NamedTuple):
    """The quantities of a task.

    Attributes:
        all: The quantities.
        read: Returns their values, in their order, of an environment between two steps. Of a
            prototype that stands for N environments, it returns arrays of shape (N,).
    """

    all: Sequence[Quantity]
    read: Callable[[Any], Sequence[Any]]


KEPT_NAMES: Final = tuple(one.attribute for one in KEPT)
_present: Final = attrgetter(*PREVIOUS.values())
"""The values that are kept when a step begins."""

_NUMBERS: Final = [(one.attribute, one.zero) for one in KEPT if one.shape == "number"]
"""Counts and flags, which are zero in an episode that begins."""


class Episode:
    """The quantities of an episode, which hooks read from their environment; see ``QUANTITIES``.

    In a single environment, each value is a number or a tuple of numbers. In a batch of N
    environments it is an array with the environments on its last axis.

    Args:
        out: The outputs and monitored variables by name.
        width: The number of outputs, which come before the monitored variables.
        values: The quantities by their attributes.

    Attributes:
        out: As given.
        width: As given.
        previous: The values before the step, in the order of ``PREVIOUS``; each also has a name.
        state: The outputs only.
        outputs: With the monitored variables.
        previous_state, inputs, action, previous_action, step_count, done, after_end, parameters,
            variables: See ``FMUEnv``.
    """

    __slots__ = (
        *(name for name in KEPT_NAMES if name not in PREVIOUS),
        *("out", "parameters", "previous", "state", "variables", "width"),
    )

    if TYPE_CHECKING:
        out: NamedValues
        width: int
        parameters: Mapping[str, Any]
        variables: EpisodeVariables
        outputs: Any
        state: Any
        previous: tuple[Any, ...]
        inputs: Any
        action: Any

        def __getattr__(self, name: str) -> Any: ...
        def __setattr__(self, name: str, value: Any) -> None: ...

    def __init__(self, out: NamedValues, width: int, **values: Any) -> None:
        self.out, self.width, self.previous = out, width, (None,) * len(PREVIOUS)
        for name, value in values.items():
            setattr(self, name, value)
        self.state = self.outputs[:width]

    def clear(
        self, indices: IndexArray, inputs: Sequence[float], action: Any, values: EpisodeValues
    ) -> None:
        """Begin the episode of one environment; see ``fmugym.environment.reset.ResetEpisodes``."""
        self.inputs, self.action, self.parameters = tuple(inputs), action, values.parameters
        for name, zero in _NUMBERS:
            setattr(self, name, zero)
        dict.update(self.variables, values.variables)

    def look(self, indices: IndexArray, outputs: FloatArray) -> None:
        """See ``ResetEpisodes.look``; of a single environment."""
        self.outputs = tuple(outputs[:, 0].tolist())
        self.state = self.outputs[: self.width]
        self.keep()

    def some(self, indices: IndexArray) -> Episode:
        """See ``ResetEpisodes.some``; of a single environment."""
        return self.mapped(_as_row)

    def row(self, name: str) -> Any:
        """See ``ResetEpisodes.row``; of a single environment."""
        return _as_row(self.variables[name])

    def warmed(self, indices: IndexArray, values: Mapping[str, Any], inputs: FloatArray) -> None:
        """See ``ResetEpisodes.warmed``; of a single environment."""
        for name, row in values.items():
            part = row[..., 0]
            self.variables[name] = part.item() if part.ndim == 0 else part
        self.inputs = tuple(inputs[:, 0].tolist())

    def copy(self) -> Episode:
        """The same episode in an object of their own; the values are not copied."""
        return self.mapped(lambda value: value)

    def replaced(self, **values: Any) -> Episode:
        """A copy of the episode with other values of these quantities; outputs make the state."""
        result = self.copy()
        for name, value in values.items():
            setattr(result, name, value)
        result.state = result.outputs[: self.width]
        return result

    def mapped(self, each: Callable[[Any], Any]) -> Episode:
        """The same episode, with a function applied to each value."""
        variables = EpisodeVariables(self.variables)
        variables.update({name: each(value) for name, value in self.variables.items()})
        parameters = ParameterValues((n, each(value)) for n, value in self.parameters.items())
        result = Episode(
            self.out,
            self.width,
            parameters=MappingProxyType(parameters),
            variables=variables,
            **{name: each(getattr(self, name)) for name in KEPT_NAMES},
        )
        result.out = self.out.over(lambda: result.outputs)
        return result

    def keep(self) -> tuple[Any, ...]:
        """Keep the quantities before the step that begins.

        Returns:
            For ``take_back``, if the FMU does not step.
        """
        before = self.previous, self.action, self.inputs
        self.previous = _present(self)
        return before

    def take_back(self, before: tuple[Any, ...]) -> None:
        """Undo ``keep``: restore the quantities before the step, the action and the inputs."""
        self.previous, self.action, self.inputs = before


def _as_row(value: Any) -> Any:
    return np.asarray(value)[..., np.newaxis]


def _previous_value(place: int) -> Any:
    """Make a property that is one of the values before the step."""

    def get(self: Episode) -> Any:
        return self.previous[place]

    def put(self: Episode, value: Any) -> None:
        self.previous = (*self.previous[:place], value, *self.previous[place + 1 :])

    return property(get, put)


for _place, _name in enumerate(PREVIOUS):
    setattr(Episode, _name, _previous_value(_place))


class NoEpisode:
    """Placeholder of an episode until the constructor of ``FMUEnv`` has made one."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(_too_early(name), name=name)

    def __setattr__(self, name: str, value: Any) -> None:
        raise ConfigError(f"{_too_early(name)}; give an attribute of your own another name")


def _too_early(name: str) -> str:
    return f"{name!r} is what hooks read, which there is after super().__init__(...) only"


READABLE: Final = (
    *("state", "out"),
    *(one.attribute for one in KEPT if one.name != "outputs"),
    *(one.attribute for one in QUANTITIES.values() if one.shape == "named"),
)
"""The attributes of an environment that hooks read."""


def read_by(name: str) -> Any:
    """Make a property of environments that is a quantity of their episode."""

    def put(env: Any, value: Any) -> None:
        setattr(env._episode, name, value)

    return property(attrgetter(f"_episode.{name}"), put)


def environments_first(values: Any) -> Any:
    """View an array with its last axis first."""
    if type(values) is np.ndarray and values.ndim <= 2:
        return values.T  # moveaxis takes ten times as long
    return np.moveaxis(values, -1, 0)


def environments_last(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """View an array with its first axis last."""
    return values.T if values.ndim <= 2 else np.moveaxis(values, 0, -1)


@contextmanager
def standing_in(env: Any, episode: Episode) -> Iterator[None]:
    """Let the hooks of an environment read other values inside of a ``with`` block.

    The environment stays the same object. So objects and functions that it holds, and that refer
    to it, read the same values as its hooks.
    """
    with env._standing_in:
        before, env._episode = env._episode, episode
        try:
            yield
        finally:
            env._episode = before
