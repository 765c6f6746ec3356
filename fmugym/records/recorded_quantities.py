"""Recorded quantities: the values of environments that a recorder reads and writes down.

Rows of time series are made of them and of the results of steps, of one environment or N.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from fmugym.checks import normal_form
from fmugym.environment.env import FMUEnv
from fmugym.environment.episode import Quantities, Quantity
from fmugym.environment.fmu_variables import require_numeric, start_time_of
from fmugym.errors import unknown_name
from fmugym.fmi.variable import Variable
from fmugym.pool.pool import FloatArray, MaskArray, Pool
from fmugym.records.time_series import TimeSeries

__all__ = [
    "Infos",
    "RecordedEnvs",
    "RecordedQuantities",
    "RecordedStep",
    "RowMaker",
    "batched_info",
    "choose",
    "matches",
    "quantities_of",
]

_VARYING: Final = ("continuous", "discrete")


class RecordedEnvs(Protocol):
    """Interface of N environments that a recorder reads.

    Attributes:
        prototype: One of them.
        count: N.
        is_vector: Whether they are those of a vector environment.
    """

    prototype: FMUEnv
    count: int
    is_vector: bool

    def evaluate(self, function: Callable[[Any], Sequence[Any]], indices: Any) -> FloatArray:
        """Evaluate a function of M of the environments; shape (k, M)."""

    @property
    def pool(self) -> Pool:
        """Reads variables of the FMUs."""


class RecordedQuantities(NamedTuple):
    """Quantities that a recorder writes down.

    Attributes:
        quantities: All of them, in the order of the columns.
        places: Which of the task's quantities are the first ones.
        read: Reads all of the task's quantities of an environment.
        variables: Variables of the FMU that come next.
        observed: The elements of the observation that come last.
    """

    quantities: tuple[Quantity, ...]
    places: tuple[int, ...]
    read: Callable[[Any], Sequence[Any]]
    variables: tuple[Variable, ...]
    observed: tuple[int, ...]

    def present(self, episodes: RecordedEnvs, indices: Any) -> FloatArray:
        """Present values of M environments, without the observations.

        Args:
            episodes: All environments.
            indices: The M environments.

        Returns:
            One row for each environment, one column for each quantity.
        """
        rows = [episodes.evaluate(self.read, indices)[list(self.places)]]
        if self.variables:
            rows.append(episodes.pool.read(self.variables)[:, indices])
        return np.concatenate(rows).T

    def seen(self, observations: Any, indices: Any) -> FloatArray:
        """Observations of M environments; no values if observations are no arrays.

        Args:
            observations: Observations of all environments.
            indices: The M environments.

        Returns:
            One row for each environment, one column for each element.
        """
        if not isinstance(observations, np.ndarray):
            return np.empty((len(indices), 0))
        rows = observations[indices].reshape(len(indices), -1)
        chosen: FloatArray = rows[:, list(self.observed)].astype(np.float64)
        return chosen


def matches(pattern: str, name: str) -> bool:
    """Whether a name matches a glob: * is any text, ? one character, brackets are themselves."""
    pattern, name = normal_form(pattern), normal_form(name)
    expression = re.escape(pattern).replace(r"\*", ".*").replace(r"\?", ".")
    return re.fullmatch(expression, name, re.DOTALL) is not None


def choose(env: FMUEnv, patterns: Iterable[str] | None) -> RecordedQuantities:
    """Find the values that globs name.

    Args:
        env: The environment, or the prototype of many.
        patterns: Globs. They choose among the names of the task, the varying variables of the FMU
            that the task has no name for, and ``observation.NAME``, what the agent sees of a name.
            None for all names of the task except parameters.

    Raises:
        ConfigError: If a glob matches nothing.
    """
    quantities, read = quantities_of(env)
    others = {variable.name: variable for variable in _others(env, quantities)}
    seen = {f"observation.{name}": index for index, name in enumerate(_observation_names(env))}
    if patterns is None:
        wanted = {one.name for one in quantities if one.kind != "parameter"}
    else:
        named = [one.name for one in quantities] + [n for n in others if _varies(others[n])]
        known = [*named, *seen]
        for pattern in patterns:
            _require_numbers(env, pattern)
        wanted = {name for one in patterns for name in _found(one, known, others)}
    places = tuple(i for i, one in enumerate(quantities) if one.name in wanted)
    variables = tuple(others[name] for name in others if name in wanted)
    observed = tuple(index for name, index in seen.items() if name in wanted)
    return RecordedQuantities(
        (
            *(quantities[place] for place in places),
            *map(_of_variable, variables),
            *(Quantity(name, "observation") for name in seen if name in wanted),
        ),
        places,
        read,
        variables,
        observed,
    )


def _require_numbers(env: FMUEnv, name: str) -> None:
    """Refuse a variable of the FMU that can never be read."""
    variable = env.fmu.description.variables.get(name)
    if variable is not None and not variable.is_number and not variable.ticking:
        require_numeric(variable, "recorded")


def _found(pattern: str, known: Sequence[str], others: Iterable[str]) -> list[str]:
    """The names that a glob finds; constants and parameters must be named in full.

    The name of an array stands for its elements.
    """
    own = normal_form(pattern)
    arrays = {name: _array_of(normal_form(name)) for name in (*known, *others)}
    found = [name for name in known if matches(pattern, name) or arrays[name] == own]
    found += [n for n in others if own in {normal_form(n), arrays[n]} and n not in found]
    if not found:
        raise unknown_name("variable to record", pattern, [*known, *others])
    return found


def _array_of(name: str) -> str:
    """The name of the array of which this is an element; "" if it is none."""
    return name.rpartition("[")[0] if name.endswith("]") else ""


def _varies(variable: Variable) -> bool:
    return variable.variability in _VARYING and variable.causality != "independent"


def quantities_of(env: FMUEnv) -> Quantities:
    """Quantities of a task, or of the config if there is no task."""
    of_task = None if env.resolved is None else env.resolved.quantities
    return _of_config(env) if of_task is None else of_task()


def _of_config(env: FMUEnv) -> Quantities:
    interface, strings = env.interface, env.fmu.description.strings
    inputs, outputs = interface.inputs, (*interface.outputs, *interface.monitors)
    episode = [n for n, value in env.config.variable_starts.items() if np.ndim(value) == 0]
    parameters = tuple(name for name in interface.parameters if name not in strings)

    def read(env: Any) -> Sequence[Any]:
        drawn, variables = env.parameters, env.variables
        return (
            *(env.inputs[index] for index in range(len(inputs))),
            *env.out.values(),
            *(variables[name] for name in episode),
            *(drawn.get(name, np.nan) for name in parameters),
        )

    found = [_of_variable(variable, "action") for variable in inputs]
    found += [_of_variable(variable) for variable in outputs]
    found += [Quantity(name, "memory") for name in episode]
    for name in parameters:
        variable = interface.parameter(name, interface.parameters[name])
        found.append(replace(_of_variable(variable, "parameter"), name=name))
    return Quantities(found, read)


def _of_variable(variable: Variable, kind: str = "output") -> Quantity:
    return Quantity(variable.name, kind, variable.unit or "", *variable.range)


def _others(env: FMUEnv, quantities: Sequence[Quantity]) -> Iterator[Variable]:
    """Numbers of the FMU for which the task has no name of its own."""
    known = {*env.interface.input_names, *env.out, *(one.name for one in quantities)}
    for variable in env.fmu.description.variables.values():
        if variable.is_number:
            yield from (one for one in variable.elements if one.name not in known)


def _observation_names(env: FMUEnv) -> Sequence[str]:
    space = env.observation_space
    if env.observation_names is not None:
        return env.observation_names
    if isinstance(space, spaces.Box):
        return [str(index) for index in range(int(np.prod(space.shape)))]
    return []


_GROUPS: Final = {"reward_terms": "reward term", "costs": "cost term"}
_TOLD: Final = {"kpis": "kpi", "proposed": "proposal", "predicted": "prediction"}
"""The kinds of numbers in infos that are written down as they are, by the key of the info."""


class Infos(NamedTuple):
    """The infos of N environments.

    Attributes:
        of_envs: As a vector environment gives them.
        num_envs: N.
        last: The infos with which episodes have ended, where those of the next ones are in
            ``of_envs``.
        ended: The environments that these are of, shape (N,).
    """

    of_envs: Mapping[str, Any]
    num_envs: int
    last: Mapping[str, Any] = MappingProxyType({})
    ended: Any = False

    def names(self, group: str) -> list[str]:
        """The names in a dict of the infos."""
        return [name for name in self.of_envs.get(group, ()) if not name.startswith("_")]

    def numbers(self, *path: str) -> FloatArray:
        """Numbers under a key of the infos, shape (N,); 0 for environments without one."""
        now = _numbers(self.of_envs, path, self.num_envs)
        last = _numbers(self.last, path, self.num_envs) if self.last else now
        return np.where(self.ended, last, now)

    def each(self, name: str) -> dict[int, Any]:
        """Values under a key, for the environments that have one."""
        ended = {*np.flatnonzero(self.ended).tolist()}
        now = {i: one for i, one in _each(self.of_envs, name).items() if i not in ended}
        return now | _each(self.last, name)


def batched_info(info: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the info of a single environment to the infos of a vector environment of one."""
    values = {
        n: batched_info(one) if isinstance(one, Mapping) else [one] for n, one in info.items()
    }
    return values | {f"_{name}": [True] for name in info}


def _numbers(infos: Mapping[str, Any], path: Sequence[str], count: int) -> FloatArray:
    *groups, name = path
    for group in groups:
        infos = infos.get(group, {})
    if name not in infos:
        return np.zeros(count)
    return np.where(infos.get(f"_{name}", True), np.asarray(infos[name], np.float64), 0.0)


def _each(infos: Mapping[str, Any], name: str) -> dict[int, Any]:
    has = infos.get(f"_{name}")
    if has is None:
        return {}
    return {index: _one(infos[name], index) for index in np.flatnonzero(has).tolist()}


def _one(values: Any, index: int) -> Any:
    if isinstance(values, Mapping):
        return {n: _one(v, index) for n, v in values.items() if not n.startswith("_")}
    return values[index]


class RecordedStep(NamedTuple):
    """Results of a step of N environments.

    Attributes:
        rewards, terminated, truncated: Shape (N,).
        infos: The infos of the steps, those of steps that ended an episode included.
        observations: Likewise.
        last: The last rows of environments whose FMU is in the next episode already
            (``infos.ended``), one for each that is written down, as ``RecordedQuantities.present``
            gives it; None without such.
    """

    rewards: FloatArray
    terminated: MaskArray
    truncated: MaskArray
    infos: Infos
    observations: Any
    last: FloatArray | None = None


class RowMaker:
    """Maker of rows from the steps of environments.

    Args:
        episodes: The environments.
        choice: The values to write down.
        indices: The environments to write down.
        every: The number of steps from one row to the next. Rewards and costs in a row are the sums
            since the row before.
        infos: Infos of the first reset, which tell the terms of rewards and costs.

    Attributes:
        none: No rows, with the columns of all that follow.
    """

    def __init__(
        self,
        episodes: RecordedEnvs,
        choice: RecordedQuantities,
        indices: npt.NDArray[np.intp],
        every: int,
        infos: Infos,
    ) -> None:
        self._episodes, self._choice, self._indices = episodes, choice, indices
        self._every = every
        self._summed = tuple(_summed(infos))
        self._told = tuple((key, name) for key in _TOLD for name in infos.names(key))
        count = episodes.count
        self._sums = np.zeros((count, 1 + len(self._summed)))
        self._steps = np.zeros(count, np.int64)
        self._number = np.full(count, -1, np.int64)
        self._starts: Any = np.zeros(count)
        columns, limits = tuple(self._columns()), getattr(episodes.prototype, "cost_limits", {})
        self.none = TimeSeries(columns, np.empty((0, len(columns))), cost_limits=limits)

    def _columns(self) -> Iterator[Quantity]:
        if self._episodes.is_vector:
            yield Quantity("environment", "index")
        yield Quantity("episode", "index")
        yield Quantity("step", "index")
        yield Quantity("time", "time", "s")
        yield from self._choice.quantities
        yield Quantity("reward", "reward")
        for path in self._summed:
            yield Quantity(".".join(path), _GROUPS.get(path[0], "cost"))
        yield from (Quantity(f"{key}.{name}", _TOLD[key]) for key, name in self._told)
        yield Quantity("terminated", "flag")
        yield Quantity("truncated", "flag")

    def go_on(self, steps: Any) -> None:
        """Begin in the middle of episodes that have had so many steps: these have the number 0."""
        self._steps[:] = steps
        self._number[:] = 0

    def begin(self, mask: MaskArray, infos: Infos, observations: Any) -> TimeSeries:
        """Make the first rows of episodes."""
        self._number[mask] += 1
        self._steps[mask] = 0
        begun = np.flatnonzero(mask)
        self._starts[begun] = self._episodes.evaluate(lambda env: (start_time_of(env),), begun)[0]
        self._sums[mask] = 0.0
        no = np.zeros(len(mask), np.bool_)
        return self._block(mask, self._values(observations, infos), (no, no), infos)

    def add(self, outcome: RecordedStep, idle: MaskArray) -> TimeSeries:
        """Make the rows of a step.

        Args:
            outcome: Results of the step.
            idle: The environments that did not step.
        """
        terms = [outcome.infos.numbers(*path) for path in self._summed]
        self._sums += np.where(idle, 0.0, np.array([outcome.rewards, *terms])).T
        self._steps += ~idle
        ended = (outcome.terminated | outcome.truncated) & ~idle
        values = self._values(outcome.observations, outcome.infos)
        if outcome.last is not None:
            begun = outcome.infos.ended[self._indices]
            values[begun, : outcome.last.shape[1]] = outcome.last[begun]
        due = ~idle & (ended | (self._steps % self._every == 0))
        flags = outcome.terminated, outcome.truncated
        block = self._block(due, values, flags, outcome.infos)
        self._sums[due] = 0.0
        return block

    def _values(self, observations: Any, infos: Infos) -> FloatArray:
        """Values and observations of the environments; a plant may lack some values."""
        seen = self._choice.seen(observations, self._indices)
        now = self._choice.present(self._episodes, self._indices)
        values = np.concatenate([now, seen], axis=1)
        for index, missing in infos.each("missing").items():
            for place, quantity in enumerate(self._choice.quantities):
                if quantity.name in missing:
                    values[self._indices == index, place] = np.nan
        return values

    def _block(
        self,
        mask: MaskArray,
        values: FloatArray,
        flags: tuple[MaskArray, MaskArray],
        infos: Infos,
    ) -> TimeSeries:
        is_due = mask[self._indices]
        which = self._indices[is_due]
        env = self._episodes.prototype
        spec = env.pool_spec
        passed: Any = (env.warm_up_steps + self._steps[which]) * spec.substeps
        parts = [
            *([which] if self._episodes.is_vector else []),
            self._number[which],
            self._steps[which],
            spec.communication_point(passed, self._starts[which]),
            *values[is_due].T,
            *self._sums[which].T,
            *(infos.numbers(*path)[which] for path in self._told),
            *(flag[which] for flag in flags),
        ]
        rows = {index: row for row, index in enumerate(which.tolist())}
        told = {
            rows[index]: str(why) for index, why in infos.each("fault").items() if index in rows
        }
        return replace(self.none, values=np.array(parts, np.float64).T, faults=told)


def _summed(infos: Infos) -> Iterator[tuple[str, ...]]:
    yield from (("reward_terms", name) for name in infos.names("reward_terms"))
    if infos.names("costs"):
        yield ("cost",)
        yield from (("costs", name) for name in infos.names("costs"))
