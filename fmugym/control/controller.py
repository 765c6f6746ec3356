"""Base classes of controllers: binding to environments, and shapes of actions.

Their signals are expressions of observed values. Control laws are controllers given by formulas,
which are played and exported alike.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from operator import itemgetter
from types import SimpleNamespace
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from fmugym.checks import KnownArguments, Spellings, check_number
from fmugym.errors import ConfigError, shown, unknown_name
from fmugym.expressions.graph import Graph, Value, where
from fmugym.expressions.language import Expression, Names
from fmugym.expressions.numpy_evaluation import function_of
from fmugym.pool.pool import FloatArray

__all__ = [
    "Controller",
    "Decided",
    "Formula",
    "Law",
    "NumberOrArray",
    "SignalReference",
    "attribute_of",
    "checked_numbers",
    "either",
    "formula_of",
    "limited",
    "of_columns",
    "require_physical",
]

Formula = Callable[[Sequence[Value]], Value]
"""A function of the elements of an observation."""


def formula_of(text: str, names: Sequence[str]) -> Formula:
    """Make the formula of a signal.

    Args:
        text: An expression.
        names: What its names may be: those of the elements of an observation.

    Returns:
        The formula. It raises ``ConfigError`` if the expression has other names.

    Raises:
        ConfigError: If it is no expression.
    """
    expression, spellings = Expression.parse(text), Spellings("observation", names)

    def formula(observation: Sequence[Value]) -> Value:
        def find(name: str) -> Value | None:
            spelt = spellings.find(name)
            return None if spelt is None else observation[names.index(spelt)]

        graph = observation[0].graph
        return expression.value(Names(graph, find, known=lambda: list(names))).number

    return formula


def of_columns(formula: Formula, width: int) -> Callable[[Sequence[Any]], Any]:
    """The function of the elements of observations, each of shape (N,), that gives the values."""
    graph = Graph()
    value = formula([Value.read(graph, "columns", place) for place in range(width)])
    constant = value.constant
    if constant is not None:
        return lambda columns: np.full(len(columns[0]), float(constant))
    evaluate = function_of(value)
    return lambda columns: evaluate(SimpleNamespace(columns=columns))


NumberOrArray = float | FloatArray
"""A number, or an array of shape (N,) with one for each environment."""

SignalReference = str | NumberOrArray
"""An element of the observation by name, an expression of them, or a constant."""


class Controller(KnownArguments, ABC):
    """A controller of one environment, or of the N environments of a vector environment.

    Attributes:
        is_physical: Whether it reads and writes values in the units of the task, as all do that
            do not say otherwise.
        space: The action space of one environment.
        names: The names of the observation's elements.
        action_names: The names of the action's elements; None if a hook makes something of them.
        time_step: The length of a step in s.
        count: The number of environments.
    """

    is_physical: ClassVar[bool] = True
    _signals: dict[str, tuple[Formula, Callable[[Any], Any]]]

    space: spaces.Space[Any]
    names: tuple[str, ...]
    action_names: tuple[str, ...] | None
    time_step: float
    count: int
    _is_vector: bool = True

    def bind(self, env: Any, names: Iterable[str] | None = None) -> Self:
        """Prepare for an environment and forget all episodes.

        Args:
            env: A single or a vector environment of this package, or a wrapper of one.
            names: The names of the observation's elements. They are known if the observation is
                the FMU's outputs, which is the default, and for declared tasks.

        Returns:
            The controller itself.

        Raises:
            ConfigError: If the names are not known, something that the controller needs is not
                there, or the environment is of a task that is not in its physical form.
        """
        if self.is_physical:
            require_physical(env)
        self._is_vector = hasattr(env, "single_action_space")
        return self.attach(
            env.single_action_space if self._is_vector else env.action_space,
            self._names_of(env) if names is None else tuple(names),
            attribute_of(env, "action_names"),
            attribute_of(env, "config").time_step,
            env.num_envs if self._is_vector else 1,
        )

    def attach(
        self,
        space: spaces.Space[Any],
        names: tuple[str, ...],
        action_names: tuple[str, ...] | None,
        time_step: float,
        count: int,
    ) -> Self:
        """Prepare for actions of a space, as the attributes say, and forget all episodes.

        Raises:
            ConfigError: If something that the controller needs is not there.
        """
        self.space, self.names, self.action_names = space, names, action_names
        self.time_step, self.count = time_step, count
        self._signals = {}
        self._prepare()
        self.reset()
        return self

    def act(self, observation: Any, info: Any = None) -> Any:
        """Choose actions.

        Args:
            observation: Observation of shape (k,), or (N, k) for a vector environment.
            info: The infos that came with it; no controller of this package reads them.

        Returns:
            An action of the action space, or N of them.

        Raises:
            ConfigError: If the controller is not bound, or the observation has another shape.
        """
        if not hasattr(self, "names"):
            raise ConfigError(f"call {type(self).__name__}.bind(env) before act")
        actions = self._as_actions(self._decide(self._rows(observation)))
        return actions if self._is_vector else actions[0]

    def reset(self, mask: npt.NDArray[np.bool_] | None = None) -> None:
        """Begin new episodes in environments whose ``terminated`` or ``truncated`` was true.

        Args:
            mask: Which environments begin one, shape (N,); by default all.
        """
        self._forget(np.ones(self.count, dtype=bool) if mask is None else np.asarray(mask))

    # Methods of each controller.

    def _prepare(self) -> None:
        """Find the needed elements of the space and of the names."""

    @abstractmethod
    def _decide(self, rows: FloatArray) -> FloatArray:
        """Choose the actions for observations of shape (N, k): shape (N,) or (N, m)."""

    def _forget(self, mask: npt.NDArray[np.bool_]) -> None:
        """Forget the episodes of some environments."""

    def add(self, added: FloatArray) -> None:
        """Tell the controller a correction that was added to its last decision, after the limits.

        An integral does not grow while the sum is at a limit.

        Args:
            added: Shape (N, m).
        """

    def decision(
        self,
        observation: Sequence[Value],
        memory: Sequence[Value] = (),
        added: Sequence[Value] | None = None,
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """The formulas of a decision, of a controller of one environment.

        Args:
            observation: Its elements, as float64.
            memory: The numbers that it remembers.
            added: Correction of the elements of the action, see ``add``.

        Returns:
            The elements of the action, before they are limited, and the numbers that it remembers
            then.

        Raises:
            ConfigError: If there are no such formulas.
        """
        raise ConfigError(
            f"a controller of type {type(self).__name__} cannot be exported; a PID, a Hysteresis, "
            "a Schedule, a ControllerTable and an LQR can be"
        )

    def _names_of(self, env: Any) -> tuple[str, ...]:
        """Names of the elements of the environment's observation."""
        names: tuple[str, ...] | None = attribute_of(env, "observation_names")
        if names is None:
            raise ConfigError(
                "the elements of these observations have no names, because a hook makes them: play "
                f"a task file, as 'fmugym new {attribute_of(env, 'fmu').path} --output task.toml' "
                "writes one, or give bind their names in order"
            )
        return names

    def _rows(self, observation: Any) -> FloatArray:
        """Observations as numbers, shape (N, k)."""
        rows = np.atleast_2d(np.asarray(observation, dtype=np.float64))
        if rows.shape != (self.count, len(self.names)):
            raise ConfigError(
                f"expected an observation of {self._shape()}, got one of shape "
                f"{np.shape(observation)}"
            )
        return rows

    # Shared by controllers.

    def _value(self, seen: Sequence[Any], signal: SignalReference) -> Any:
        """The value of a signal.

        Args:
            seen: The elements of the observation: formulas, or arrays of shape (N,).
            signal: A signal that is checked, or a constant.
        """
        if not isinstance(signal, str):
            return signal
        formula, evaluate = self._signals[signal]
        return formula(seen) if isinstance(seen[0], Value) else evaluate(seen)

    def _check_signal(self, what: str, signal: SignalReference) -> None:
        """Check a signal; one that is no name may be an expression."""
        if not isinstance(signal, str):
            self._check_size(what, checked_numbers(what, signal))
        elif signal.isidentifier() or self._is_name(signal):
            self._check_name(what, signal)
            element = itemgetter(self._place_of(signal))
            self._signals[signal] = element, element
        else:
            try:
                formula = formula_of(signal, self.names)
                self._signals[signal] = formula, of_columns(formula, len(self.names))
            except ConfigError as error:
                raise ConfigError(f"{what}: {error}") from None

    def _check_name(self, what: str, name: str) -> None:
        """Check the name of an observation."""
        if not self._is_name(name):
            raise ConfigError(unknown_name(f"observation in {what}", name, self.names))

    def _is_name(self, name: str) -> bool:
        return Spellings("observation", self.names).find(name) is not None

    def _place_of(self, name: str) -> int:
        """The place of an observation whose name is checked."""
        if name in self.names:
            return self.names.index(name)
        return self.names.index(str(Spellings("observation", self.names).find(name)))

    def _check_size(self, what: str, numbers: NumberOrArray | None) -> None:
        """Check that an array has one number for each environment."""
        size = np.size(numbers) if np.ndim(numbers) else self.count  # type: ignore[arg-type] # None is a scalar, too
        if size != self.count:
            raise ConfigError(f"{what} has {size} numbers, but there are {self.count} environments")

    def _limits(self) -> tuple[float, float]:
        """The lowest and the highest action of a space with one element."""
        space = self.space
        if isinstance(space, spaces.Box) and space.shape in ((), (1,)):
            return float(space.low.item()), float(space.high.item())
        if isinstance(space, spaces.Discrete):
            return float(space.start), float(space.start + space.n - 1)
        raise ConfigError(
            f"{type(self).__name__} gives one number, but the action space is {shown(space)}"
        )

    def _as_actions(self, values: FloatArray) -> Any:
        """Round or clip values to the action space and give them its shape and type."""
        space = self.space
        if isinstance(space, spaces.Discrete):
            least, largest = self._limits()
            return np.clip(np.rint(values.ravel()), least, largest).astype(space.dtype)
        values = values.reshape(len(values), *space.shape or ())
        if isinstance(space, spaces.Box):
            values = limited(values, space.low, space.high)
        elif isinstance(space, spaces.MultiDiscrete):
            values = limited(np.rint(values), space.start, space.start + space.nvec - 1)
        return values.astype(space.dtype)

    def action_of(self, values: Sequence[Value]) -> list[Value]:
        """The elements of an action as ``act`` returns them: limited, and in the space's type.

        Args:
            values: The elements before that.
        """
        space: Any = self.space
        if isinstance(space, spaces.Discrete):
            values = [limited(np.rint(one), *self._limits()) for one in values]
        elif isinstance(space, spaces.Box):
            limits = zip(values, space.low.flat, space.high.flat, strict=True)
            values = [limited(one, low, high) for one, low, high in limits]
        elif isinstance(space, spaces.MultiDiscrete):
            ends = space.start.ravel(), (space.start + space.nvec - 1).ravel()
            limits = zip(values, *(end.tolist() for end in ends), strict=True)
            values = [limited(np.rint(one), low, high) for one, low, high in limits]
        return [one.cast(space.dtype) for one in values]

    def _shape(self) -> str:
        width = len(self.names)
        return f"shape ({self.count}, {width})" if self._is_vector else f"shape ({width},)"


def limited(values: Any, low: Any, high: Any) -> Any:
    """Limit values as ``numpy.clip`` does, in less time for up to some hundred numbers.

    Formulas are limited alike.
    """
    return np.minimum(np.maximum(values, low), high)


def either(condition: Any, first: Any, second: Any) -> Any:
    """Choose between values as ``numpy.where`` does, of formulas, too."""
    if isinstance(condition, Value):
        return where(condition, first, second)
    return np.where(condition, first, second)


def checked_numbers(what: str, value: Any, **limits: Any) -> NumberOrArray:
    """Return a number as a float, or a one-dimensional array of floats.

    Args:
        what: Its name, for the error.
        value: Any object.
        limits: As for ``check_number``.

    Raises:
        ConfigError: If one of them is no number, or out of its range.
    """
    if isinstance(value, np.ndarray) and value.ndim == 1:
        return np.array([check_number(f"each {what}", one, **limits) for one in value.tolist()])
    return check_number(what, value, **limits)


def require_physical(env: Any) -> None:
    """Refuse an environment whose observations or actions are not in the units of its task.

    Args:
        env: A single or a vector environment of this package, or a wrapper of one.

    Raises:
        ConfigError: If a key of the task gives them another form. The text has the cure.
    """
    keys = attribute_of(env, "unphysical_keys")
    if keys:
        name = attribute_of(env, "task").name
        raise ConfigError(
            f"{', '.join(map(repr, keys))} of {name} give observations or actions a form for "
            "agents, but controllers read and write values in the units of the task: make the "
            f"environment with fmugym.load({name!r}, physical=True), or of Task.physical()"
        )


def attribute_of(env: Any, name: str) -> Any:
    """An attribute of an environment, or of the first of many."""
    base: Any = env.unwrapped
    is_vector = isinstance(base, VectorEnv)
    return getattr(base.prototype if is_vector else base, name)


Decided = tuple[Sequence[Any], tuple[Any, ...]]
"""Elements of an action before the limits, and the new memory of a controller."""


class Law(Controller):
    """Controller given by formulas of the observation and a few remembered numbers.

    Attributes:
        starts: The numbers that it remembers, at the beginning of an episode.
        signals: The attributes that are signals.
    """

    starts: tuple[NumberOrArray, ...] = ()
    _before: tuple[Sequence[Any], Sequence[Any]]
    signals: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def law(
        self, seen: Sequence[Any], state: Sequence[Any], holds: Any = False, added: Any = None
    ) -> Decided:
        """Compute a decision: of arrays element by element, or of formulas.

        Args:
            seen: The elements of the observation.
            state: Memory of the controller, in the order of ``starts``.
            holds: Whether an integral must not grow, because nothing would follow it.
            added: Correction of each element of the action; None for nothing. See
                ``Controller.add``.
        """

    @property
    def integrates(self) -> bool:
        """Whether it has an integral, which may wind up."""
        return False

    def wanted(self, seen: Sequence[Any], state: Sequence[Any]) -> Any:
        """The action that it would take if there were no limits, as its only element."""
        return self.law(seen, state)[0][0]

    def measured(self) -> list[str]:
        """Measured value and set point: names and other expressions."""
        given = (getattr(self, name) for name in self.signals)
        return [one for one in given if isinstance(one, str)]

    def decision(
        self,
        observation: Sequence[Value],
        memory: Sequence[Value] = (),
        added: Sequence[Value] | None = None,
    ) -> tuple[Sequence[Value], Sequence[Value]]:
        """See ``Controller.decision``."""
        elements, state = self.law(observation, memory, added=added)
        return [observation[0].beside(one) for one in elements], state

    def _prepare(self) -> None:
        for name in self.signals:
            if (signal := getattr(self, name)) is not None:
                self._check_signal(name, signal)
        self._state = tuple(np.full(self.count, start) for start in self.starts)

    def _forget(self, mask: npt.NDArray[np.bool_]) -> None:
        pairs = zip(self.starts, self._state, strict=True)
        self._state = tuple(np.where(mask, start, now) for start, now in pairs)

    def add(self, added: FloatArray) -> None:
        """See ``Controller.add``."""
        _, self._state = self.law(*self._before, added=[*added.T])

    def _decide(self, rows: FloatArray) -> FloatArray:
        self._before = [*rows.T], self._state
        elements, self._state = self.law(*self._before)
        return np.stack([np.broadcast_to(one, len(rows)) for one in elements], axis=-1)
